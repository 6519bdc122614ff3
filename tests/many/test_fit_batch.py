"""Fits of several images in one program, against fits of single images."""

import os
import signal
import threading
from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.sets import check_equal
from _helpers.waves import picture
from eigengs_dr.fitting.fit import fit_images
from eigengs_dr.fitting.options import FitOptions
from eigengs_dr.fitting.place import Adaptive, Grid, Random
from eigengs_dr.gaussian.file import CUTOFF
from eigengs_dr.gaussian.gaussians import MIN_DEVIATION
from eigengs_dr.image.pixels import EncodedImage
from eigengs_dr.many.fit_many import MAX_CUTOFF, _is_groupable, _may_join
from eigengs_dr.paper.gaussianimage import GAUSSIANIMAGE
from eigengs_dr.raster.evaluate import is_steep
from eigengs_dr.raster.parameters import kernel_radius, kernel_shape


def pictures(count, height=30, width=33):
    """Different images whose sides are no multiples of a tile."""
    return np.stack([np.roll(picture(height, width), 5 * k, axis=1) for k in range(count)])


def options(backend, **changed):
    return FitOptions(**{"gaussians": 60, "iterations": 30, "backend": backend, **changed})


@pytest.mark.parametrize("color", ["ycbcr", "linear", "data"])
@pytest.mark.parametrize("place", [Adaptive(), Random()])
def test_results_are_those_of_single_fits(backend, color, place):
    """On llvm bit for bit."""
    method = replace(eg.DEFAULT, place=place)
    settings = options(backend, space=color, method=method)
    for image, found in zip(pictures(3), fit_images(pictures(3), settings), strict=True):
        alone = eg.fit(image, 60, 30, method=method, space=color, backend=backend)
        for row, other in zip(found.trace, alone.trace, strict=True):
            assert row["iteration"] == other["iteration"]
            assert row["psnr_ycbcr"] == pytest.approx(other["psnr_ycbcr"], abs=0.05)
            assert row["psnr_rgb"] == pytest.approx(other["psnr_rgb"], abs=0.05)
        assert found.stopped == alone.stopped and found.iterations == alone.iterations
        if backend == "llvm":
            assert_same_bits(found, alone)
        # The image is the rendering of the set, which is a set as any other.
        shown = eg.render(found.gaussians).numpy()
        if color != "linear":
            np.testing.assert_allclose(shown, found.image, atol=1e-5)


def assert_same_bits(found, expected):
    """The same set, picture and trace."""
    check_equal(found.gaussians, expected.gaussians.to_arrays())
    np.testing.assert_array_equal(found.image, expected.image)
    keys = ("iteration", "psnr_ycbcr", "psnr_rgb")
    for row, other in zip(found.trace, expected.trace, strict=True):
        assert [row[key] for key in keys] == [other[key] for key in keys]


def test_default_fits_have_the_bits_of_single_ones():
    """A thousand steps, until Gaussians are as narrow as they may be."""
    photo = eg.sample("coffee")
    crops = [photo[y : y + 48, x : x + 48] for y, x in ((40, 60), (110, 190), (200, 300))]
    together, two = (eg.fit_many(part, gaussians=300) for part in (crops, crops[:2]))
    alone = eg.fit(crops[1], gaussians=300)
    assert np.abs(alone.gaussians.to_arrays()["factor"]).max() > 0.99 / MIN_DEVIATION
    assert_same_bits(together[1].result, alone)
    for row, other in zip(together, two, strict=False):
        assert_same_bits(row.result, other.result)


def test_no_gaussian_of_a_batch_is_steep():
    """A steep one would change the arithmetic of the images beside its own."""
    corners = np.array([[a, b, c] for a in (0, 9) for b in (-9, 0, 9) for c in (0, 9)], np.float32)
    count = len(corners)
    narrowest = eg.Gaussians.from_arrays(
        np.full((count, 2), 4), corners + 1e-9, np.zeros((count, 3)), size=(8, 8), backend="llvm"
    ).bounded()
    for cutoff, expected in ((CUTOFF, False), (MAX_CUTOFF, False), (4.0, True)):
        steep = is_steep(kernel_shape(narrowest), kernel_radius(cutoff))
        assert steep.numpy().any() == expected


def test_many_gaussians_an_image():
    """Dr.Jit adds up more than 32,768 numbers in another order in batches."""
    images = pictures(2, 180, 190)
    rows = eg.fit_many(images, gaussians=33000, iterations=0)
    assert_same_bits(rows[1].result, eg.fit(images[1], 33000, 0))


def test_an_image_that_is_done_rests(backend):
    """A constant image is exact at once; its trace ends there."""
    images = pictures(2)
    images[0] = 0.25
    flat, other = fit_images(images, options(backend, iterations=60))
    assert flat.stopped == "exact" and flat.iterations < 60
    assert other.stopped == "iterations" and other.iterations == 60
    np.testing.assert_allclose(flat.image, 0.25, atol=1e-4)


def test_interrupts_end_the_batch(backend):
    threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        fit_images(pictures(2), options(backend, iterations=100_000))


@pytest.mark.parametrize(
    ("changed", "expected"),
    [({}, True), ({"method": replace(eg.DEFAULT, place=Grid())}, True),
     ({"method": GAUSSIANIMAGE}, False), ({"gaussians": [20, 60]}, False),
     ({"target_psnr": 30.0, "gaussians": None}, False), ({"start": "set.npz"}, False),
     ({"method": replace(eg.DEFAULT, cutoff=4.0)}, False), ({"gaussians": 33000}, False)],
)  # fmt: skip
def test_which_options_go_together(changed, expected):
    image, wide = (
        EncodedImage(np.zeros(shape, np.float32), "srgb") for shape in ((256, 256, 3), (257, 8, 3))
    )
    settings = options(None, **changed)
    assert _is_groupable(image, settings) == _may_join([image], image, settings) == expected
    assert not _is_groupable(wide, settings) and not _may_join([image], wide, settings)

"""Images of one size are fitted in one program, with the results of single fits."""

from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.sets import check_equal
from _helpers.waves import picture


def pictures(count, height=30, width=33):
    """Different images whose sides are no multiples of a tile."""
    return [np.roll(picture(height, width), 5 * k, axis=1) for k in range(count)]


def assert_same_bits(found, expected):
    """The same set, picture and trace."""
    check_equal(found.gaussians, expected.gaussians.to_arrays())
    np.testing.assert_array_equal(found.image, expected.image)
    assert found.stopped == expected.stopped and found.iterations == expected.iterations
    keys = ("iteration", "psnr_ycbcr", "psnr_rgb")
    for row, other in zip(found.trace, expected.trace, strict=True):
        assert [row[key] for key in keys] == [other[key] for key in keys]


@pytest.mark.parametrize(
    ("options", "together"),
    [
        ({}, True),
        ({"space": "data"}, True),
        ({"method": eg.DEFAULT.without("redistribute")}, True),
        ({"encoding": "linear"}, False),
        ({"method": replace(eg.DEFAULT, cutoff=4.0)}, False),
    ],
    ids=["default", "data", "fixed", "linear", "cutoff"],
)
def test_results_are_those_of_single_fits(backend, options, together):
    """On llvm bit for bit; on cuda sums have another order."""
    settings = {"gaussians": 60, "iterations": 30, "backend": backend, **options}
    rows = eg.fit_many(pictures(3), **settings)
    assert (rows[0].seconds == rows[1].seconds) == together  # a share of the group's
    for image, row in zip(pictures(3), rows, strict=True):
        alone = eg.fit(image, **settings)
        assert row.psnr_ycbcr == pytest.approx(alone.psnr_ycbcr, abs=0.05)
        assert row.psnr_rgb == pytest.approx(alone.psnr_rgb, abs=0.05)
        if backend == "llvm":
            assert_same_bits(row.result, alone)


@pytest.mark.slow
def test_default_fits_have_the_bits_of_single_ones():
    """A thousand steps, until Gaussians are as narrow as they may be."""
    photo = eg.sample("coffee")
    crops = [photo[y : y + 48, x : x + 48] for y, x in ((40, 60), (110, 190), (200, 300))]
    together, two = (eg.fit_many(part, gaussians=300) for part in (crops, crops[:2]))
    alone = eg.fit(crops[1], gaussians=300)
    assert np.abs(alone.gaussians.to_arrays()["factor"]).max() > 3.9
    assert_same_bits(together[1].result, alone)
    for row, other in zip(together, two, strict=False):
        assert_same_bits(row.result, other.result)


def test_many_gaussians_an_image():
    """Dr.Jit adds up more than 32,768 numbers in another order in batches."""
    images = pictures(2, 180, 190)
    rows = eg.fit_many(images, gaussians=33000, iterations=0)
    assert_same_bits(rows[1].result, eg.fit(images[1], 33000, 0))


def test_an_image_that_is_done_rests(backend):
    """A constant image is exact at once; its trace ends there."""
    images = pictures(2)
    images[0][:] = 0.25
    flat, other = eg.fit_many(images, gaussians=60, iterations=60, backend=backend)
    assert flat.stopped == "exact" and flat.iterations < 60
    assert other.stopped == "iterations" and other.iterations == 60
    np.testing.assert_allclose(flat.result.image, 0.25, atol=1e-4)

"""Fits of several images in one program, against fits of single images."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.waves import picture
from eigengs_dr.collection import fit_batch as module
from eigengs_dr.collection.fit_batch import fit_batch, fits_in_batches
from eigengs_dr.fitting.options import FitOptions


def pictures(count, height=30, width=33):
    """Different images whose sides are no multiples of a tile."""
    return np.stack([np.roll(picture(height, width), 5 * k, axis=1) for k in range(count)])


def options(backend, **changed):
    return FitOptions(**{"gaussians": 60, "iterations": 30, "backend": backend, **changed})


@pytest.mark.parametrize("color", ["ycbcr", "linear", "data"])
@pytest.mark.parametrize("init", ["adaptive", "random"])
def test_results_are_those_of_single_fits(backend, color, init):
    """On llvm bit for bit."""
    settings = options(backend, color=color, init=init)
    for image, found in zip(pictures(3), fit_batch(pictures(3), settings), strict=True):
        alone = eg.fit(image, 60, 30, init=init, color=color, backend=backend)
        for row, other in zip(found.trace, alone.trace, strict=True):
            assert row["iteration"] == other["iteration"]
            assert row["psnr_ycbcr"] == pytest.approx(other["psnr_ycbcr"], abs=0.05)
            assert row["psnr_rgb"] == pytest.approx(other["psnr_rgb"], abs=0.05)
        assert found.stopped == alone.stopped and found.iterations == alone.iterations
        if backend == "llvm":
            for name, values in alone.gaussians.to_arrays().items():
                np.testing.assert_array_equal(found.gaussians.to_arrays()[name], values)
        # The image is the rendering of the set, which is a set as any other.
        shown = eg.render(found.gaussians).numpy()
        if color != "linear":
            np.testing.assert_allclose(shown, found.image, atol=1e-5)


@pytest.mark.parametrize("color", ["ycbcr", "linear"])
def test_a_surplus_leaves_every_image_alike(backend, color):
    """As in single fits: on llvm bit for bit."""
    settings = options(backend, color=color, gaussians=30, iterations=150)
    for image, found in zip(pictures(3), fit_batch(pictures(3), settings), strict=True):
        alone = eg.fit(image, 30, 150, color=color, backend=backend)
        assert [r["iteration"] for r in found.trace] == [r["iteration"] for r in alone.trace]
        assert len(found.gaussians) == 30
        if backend == "llvm":
            for name, values in alone.gaussians.to_arrays().items():
                np.testing.assert_array_equal(found.gaussians.to_arrays()[name], values)


def test_gaussians_are_placed_anew_in_long_fits(backend):
    """From 200 steps on."""
    found = fit_batch(pictures(2), options(backend, iterations=200))
    for image, result in zip(pictures(2), found, strict=True):
        alone = eg.fit(image, 60, 200, backend=backend)
        assert result.trace[-1]["psnr_ycbcr"] == pytest.approx(
            alone.trace[-1]["psnr_ycbcr"], abs=0.5
        )


def test_results_do_not_depend_on_the_other_images(backend):
    images = pictures(4)
    together = fit_batch(images, options(backend))
    for k, part in ((0, [0, 3]), (3, [3]), (3, [1, 2, 3])):
        again = fit_batch(images[part], options(backend))[part.index(k)]
        for name, values in together[k].gaussians.to_arrays().items():
            np.testing.assert_array_equal(again.gaussians.to_arrays()[name], values)


def test_an_image_that_is_done_rests(backend):
    """A constant image is at its plateau at once; its trace ends there."""
    images = pictures(2)
    images[0] = 0.25
    flat, other = fit_batch(images, options(backend, iterations=60))
    assert flat.stopped == "plateau" and flat.iterations < 60
    assert other.stopped == "iterations" and other.iterations == 60
    np.testing.assert_allclose(flat.image, 0.25, atol=1e-4)


def test_interrupts_end_the_batch(backend, monkeypatch):
    class Pressed:
        def __enter__(self):
            return lambda: True

        def __exit__(self, *details):
            return None

    monkeypatch.setattr(module, "defer_interrupts", Pressed)
    with pytest.raises(KeyboardInterrupt):
        fit_batch(pictures(2), options(backend))


def test_progress(backend):
    shares = []
    fit_batch(pictures(2), options(backend), shares.append)
    assert shares == pytest.approx([0, 1 / 3, 2 / 3, 1])


def test_too_many_gaussians_are_refused(backend):
    with pytest.raises(ValueError, match="gaussians is 5000; an image of 33x30 takes 1 to 990"):
        fit_batch(pictures(2), options(backend, gaussians=5000))


@pytest.mark.parametrize(
    ("changed", "expected"),
    [({}, True), ({"init": "grid"}, True), ({"preset": "gaussianimage"}, False),
     ({"target_psnr": 30.0, "gaussians": None}, False), ({"init": "eigen"}, False)],
)  # fmt: skip
def test_which_options_go_together(changed, expected):
    assert fits_in_batches(options(None, **changed)) == expected

"""A picture of waves and an edge, what is reached of it, and parts of methods."""

from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg
from eigengs_dr.paper import eigengs, gaussianimage

SIDE, SPLATS = 32, 100
"""Size of the pictures that are fitted, and splats in a fit: one set of kernels."""

METHODS = {
    "default": eg.DEFAULT,
    "gaussianimage": gaussianimage.GAUSSIANIMAGE,
    "eigengs": eigengs.EIGENGS,
}
methods = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)

CONTROLS = {type(control).__name__: control for control in eg.DEFAULT.controls}
"""The controls of the default method by their names."""


def often(every=5):
    """The default method with rounds in short descents too."""
    rounds = ("Surplus", "Relocate", "Perturb")
    controls = CONTROLS | {name: replace(CONTROLS[name], every=every) for name in rounds}
    return replace(eg.DEFAULT, controls=tuple(controls.values()))


def picture(height=SIDE, width=SIDE):
    """Waves and an edge, in RGB."""
    y, x = np.indices((height, width)) / SIDE
    waves = [np.sin(9 * x + 4 * y), np.sin(5 * y * y), np.cos(7 * x * y + 1)]
    image = 0.5 + 0.3 * np.stack(waves, axis=-1)
    image[(x - 0.3) ** 2 + (y - 0.6) ** 2 < 0.05] *= 0.4
    return image.astype(np.float32)


def figures(result):
    """PSNR in YCbCr of all rows of the trace."""
    return [row["psnr_ycbcr"] for row in result.trace]


def check_sound(result, image):
    """All numbers are finite, and the result is the best row and not worse than the start."""
    assert np.isfinite(result.image).all()
    assert all(np.isfinite(v).all() for v in result.gaussians.to_arrays().values())
    shown = eg.picture_of(result.gaussians)
    added = 0 if result.mean_image is None else result.mean_image
    np.testing.assert_array_equal(result.image, shown + added)
    # At 90 dB, errors of 3e-5 have the rounding of floats, 6e-8, on them: 0.2 % of an MSE.
    reached = min(eg.psnr(image, result.image, "ycbcr"), 100)
    assert reached == pytest.approx(min(max(figures(result)), 100), abs=0.01)
    assert result.psnr_ycbcr >= result.trace[0]["psnr_ycbcr"]

"""A picture of waves and an edge, the start of its refinement, and what is reached."""

from dataclasses import replace

import numpy as np
import pytest

from _helpers.sets import random_scene
from eigengs_dr.fitting.loop import descend
from eigengs_dr.fitting.method import DEFAULT
from eigengs_dr.fitting.objective import Pixels
from eigengs_dr.fitting.state import begin
from eigengs_dr.image.color import rgb_to_ycbcr
from eigengs_dr.image.metrics import MAX_PSNR, psnr
from eigengs_dr.paper.eigengs import EIGENGS
from eigengs_dr.paper.gaussianimage import GAUSSIANIMAGE
from eigengs_dr.raster.render import picture_of

SIDE, SPLATS = 32, 100
"""Size of the pictures that are fitted, and splats in a fit: one set of kernels."""

METHODS = {"default": DEFAULT, "gaussianimage": GAUSSIANIMAGE, "eigengs": EIGENGS}
methods = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)


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


def start(backend, count=SPLATS, seed=0):
    """Splats at random places, in YCbCr, and the objective of the picture."""
    scene = random_scene(seed, count, (SIDE, SIDE))
    mean = np.clip(scene.mean, 0, SIDE)
    gaussians = scene._replace(mean=mean, color=0 * scene.color).on(backend, space="ycbcr")
    return gaussians, Pixels.plain(rgb_to_ycbcr(picture()), gaussians)


def still(**changed):
    """The default method, which here places nothing anew, changed."""
    return replace(DEFAULT.without("grows", "places"), **changed)


def half_read(backend, count=2):
    """A descent of which some sets were read; they hold arrays that share NumPy's memory."""
    gaussians, objective = start(backend)
    rows = [type(row)(np.array(row)) for row in gaussians.color]
    gaussians = replace(gaussians, color=type(gaussians.color)(rows))
    states = descend(objective, still(), begin(gaussians), 5)
    for _ in range(count):
        next(states)
    return states


def check_sound(result, image):
    """All numbers are finite, and the result is the best row and not worse than the start."""
    assert np.isfinite(result.image).all()
    assert all(np.isfinite(v).all() for v in result.gaussians.to_arrays().values())
    rendered = picture_of(result.gaussians)
    added = 0 if result.mean_image is None else result.mean_image
    np.testing.assert_array_equal(result.image, rendered + added)
    reached = min(psnr(image, result.image, space="ycbcr"), MAX_PSNR)
    # At 90 dB, errors of 3e-5 have the rounding of floats, 6e-8, on them: 0.2 % of an MSE.
    assert reached == pytest.approx(min(max(figures(result)), MAX_PSNR), abs=0.01)
    assert result.psnr_ycbcr >= result.trace[0]["psnr_ycbcr"]

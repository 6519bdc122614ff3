"""A picture with a smooth half and a busy half, and the start of its fit."""

import numpy as np

from eigengs_dr.backend.arrays import types_of
from eigengs_dr.fitting import density_control
from eigengs_dr.fitting.descent import TiledImage
from eigengs_dr.fitting.options import FitOptions
from eigengs_dr.fitting.placement.adaptive import residual
from eigengs_dr.fitting.start import initialize
from eigengs_dr.image.color import rgb_to_ycbcr
from eigengs_dr.raster.render import batch_to_tiles

SIDE = 32


def picture(seed=0):
    """A smooth half and a busy one, RGB."""
    y, x = np.indices((SIDE, SIDE)) / SIDE
    image = np.stack([0.4 + 0.2 * x, 0.5 + 0.2 * y, 0.6 - 0.2 * x], axis=-1)
    noise = np.random.default_rng(seed).uniform(-0.2, 0.2, (SIDE, SIDE // 2, 3))
    image[:, : SIDE // 2] += noise
    return image.astype(np.float32)


def fitted(count=60):
    """A fit before its refinement, and its target in YCbCr."""
    image = picture()
    return initialize(image, FitOptions(gaussians=count, init="adaptive")), rgb_to_ycbcr(image)


def squared_error(gaussians, target, weight=1.0):
    """Sum of the squares of what a rendering misses."""
    return float(np.square(weight * residual(gaussians, target).astype(np.float64)).sum())


def relocate(gaussians, how, target, weight=None, **part):
    """A round of relocation for an image (H, W, C)."""
    types = types_of(gaussians.mean)
    tiles = (None if v is None else batch_to_tiles(types, v) for v in (target, weight))
    return density_control.relocate(gaussians, how, TiledImage(*tiles), **part)

"""A picture with a smooth half and a busy half, and the start of its fit."""

from dataclasses import replace

import numpy as np

import eigengs_dr as eg
from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.objective import Channels, Pixels, Target, squares_of
from eigengs_dr.image.space import space_of
from eigengs_dr.raster.render import picture_of, render, to_tensor

SIDE = 32


def picture(seed=0):
    """A smooth half and a busy one, RGB."""
    y, x = np.indices((SIDE, SIDE)) / SIDE
    image = np.stack([0.4 + 0.2 * x, 0.5 + 0.2 * y, 0.6 - 0.2 * x], axis=-1)
    noise = np.random.default_rng(seed).uniform(-0.2, 0.2, (SIDE, SIDE // 2, 3))
    image[:, : SIDE // 2] += noise
    return image.astype(np.float32)


def objective_of(image, backend=None, space="ycbcr", weight=None):
    """The squared error of an RGB image in a space of colours."""
    known = space_of(space)
    target = Target.of(np.asarray(image, np.float32), known)
    shown = [Channels("", known, slice(0, target.pixels.shape[2]), (target,))]
    return squares_of(shown, types_in(select(backend)), weight)


def objective_for(gaussians, target, weight=None):
    """The squared error of an image (H, W, C) in the space of a set, with weights."""
    return Pixels.plain(target, gaussians, weight)


def fitted(count=60, backend=None, image=None):
    """Placed Gaussians with the best colours, and the objective, in YCbCr."""
    objective = objective_of(picture() if image is None else image, backend)
    return eg.DEFAULT.place_and_solve(objective, count), objective


def squared_error(gaussians, objective):
    """``sum h (p - t)^2`` of a rendering, by NumPy in float64."""
    model, plain = objective.model, replace(gaussians, space="data")  # no conversion to RGB
    missed = render(plain).numpy().astype(np.float64)
    missed -= objective.picture(model.target).numpy()
    if model.curvature is None:
        return float(np.square(missed).sum())
    channels = missed.shape[2] * len(model.curvature) // len(model.target)
    factors = to_pixels(model.curvature, objective.grid, channels)
    return float((factors * np.square(missed)).sum())


def to_pixels(values, grid, channels):
    """An image (H, W, C) from tile layout, in float64."""
    return to_tensor(values, grid, channels).numpy().astype(np.float64)


def ycbcr_psnr(gaussians, image):
    """The psnr_ycbcr of a set."""
    return eg.psnr(picture_of(gaussians), image, "ycbcr")

"""Redistribution: a new placement of the Gaussians, denser where a fit left more error.

At a density of rho Gaussians per pixel, a fit leaves a squared error of about ``e = k rho^-q`` per
pixel, with q = `eigengs_dr.fitting.placement.density.ERROR_EXPONENT`. For a given number of
Gaussians, the sum of the errors is smallest if all Gaussians have the same error ``s = e / rho``.
So the density and the error of one fit give the best density:

    rho' ~ k^(1 / (q + 1)) = rho s^(1 / (q + 1)).

Only a fit can tell parts that are hard to fit from parts that just have large second derivatives.
The errors of several neighbouring Gaussians are averaged; between these Gaussians, the density
follows the second derivatives (`eigengs_dr.fitting.placement.adaptive`). The constants were chosen
on training images of ImageNet classes and of cats, by the error after 1,000 steps.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..gaussian.gaussians import Gaussians
from ..gaussian.like import like
from ..image.resize import resample
from ..image.strips import map_threads, strips
from ..raster.render import render
from .placement.adaptive import Density, place_adaptive
from .placement.density import target_density
from .solvers.conjugate_gradient import solve

Array = NDArray[np.floating]


def redistribute(
    gaussians: Gaussians,
    count: int,
    image: Array,
    target: NDArray[np.float32],
    weight: Array | None = None,
    solve_steps: int = 10,
) -> Gaussians:
    """Place a new set, denser where the old set left more error, and solve for its colours.

    Parameters
    ----------
    gaussians : Gaussians
        The old set, after some steps of a fit.
    count : int
        Number of Gaussians of the new set, from 1 to H W.
    image : ndarray, shape (H, W, C)
        The image that shapes the Gaussians, see `eigengs_dr.fitting.placement.adaptive`.
    target : ndarray of float32, shape (H, W, C)
        The image in the space of the set.
    weight : ndarray, shape (H, W, C), optional
        Factor of the errors before squaring.
    solve_steps : int, optional
        Steps of the colour solve, see `eigengs_dr.fitting.solvers.conjugate_gradient`.

    Returns
    -------
    Gaussians
        The new set. It keeps no Gaussian of the old set.
    """
    error = squared_error(residual(gaussians, target), weight)
    density = density_for_error(gaussians.to_arrays()["mean"], error)
    return place_like(gaussians, image, target, count, density, solve_steps)


def density_for_error(mean: Array, error: NDArray[np.float32]) -> Density:
    """Return the density of a new set for the means (N, 2) and the error (H, W) of the old set."""

    def density(default: Array) -> Array:
        height, width = default.shape
        if (height, width) == error.shape:
            return target_density(mean, error, default)
        # The placement shrinks the image.
        there = mean * np.array([width / error.shape[1], height / error.shape[0]])
        here = np.maximum(resample(error[..., None], width, height)[..., 0], 0)
        return target_density(there, here, default)

    return density


def place_like(
    gaussians: Gaussians,
    image: Array,
    target: NDArray[np.float32],
    count: int,
    density: Density | None = None,
    solve_steps: int = 10,
) -> Gaussians:
    """Place Gaussians by an image in the space and size of another set; solve for their colours.

    For the parameters see `redistribute`, and for the density
    `eigengs_dr.fitting.placement.adaptive.place_adaptive`.
    """
    mean, factor = place_adaptive(image, count, density=density)
    placed = like(gaussians, mean, factor, np.zeros((count, gaussians.channels), np.float32))
    return solve(placed.bounded(), target, solve_steps).gaussians


def residual(gaussians: Gaussians, target: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the target minus the rendering of a set, both in its space: shape (H, W, C)."""
    shown = render(replace(dr.detach(gaussians), space="data"))
    return np.asarray(target - shown.numpy(), np.float32)


def squared_error(missed: Array, weight: Array | None = None) -> NDArray[np.float32]:
    """Return the sum of the squares of the channels of a residual (H, W, C): shape (H, W).

    The weight, of the same shape, is a factor of the errors before squaring.
    """
    error = np.zeros(missed.shape[:2], np.float32)

    def add_up(rows: slice) -> None:
        for channel in range(missed.shape[2]):
            part = missed[rows, :, channel]
            part = part if weight is None else part * weight[rows, :, channel]
            error[rows] += np.square(part)

    map_threads(add_up, strips(*missed.shape[:2]))
    return error

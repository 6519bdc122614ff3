"""Products with the matrix A of the colour solve, which is never stored.

Column n of A holds the weights of Gaussian n at all pixels; the last column is 1. A rendering
computes a product with A, an adjoint a product with its transpose.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...backend.arrays import Float, rcp, types_of
from ...gaussian.file import MAX_CUTOFF
from ...gaussian.gaussians import Gaussians
from ...raster.adjoint import adjoint
from ...raster.binning.lists import TileLists
from ...raster.binning.tiles import Grid
from ...raster.kernels import channel_sums, residual, sum_by_image
from ...raster.parameters import NUM_SHAPE_PARAMS, detached_shape, kernel_radius, pack_parameters
from ...raster.render import bin_gaussians, to_tiles


def inner_products(
    gaussians: Gaussians, image: NDArray[Any], squared: bool = False
) -> NDArray[Any]:
    """Return the inner products of the weights of every Gaussian with an image.

    Parameters
    ----------
    gaussians : Gaussians
        The function ignores the colours.
    image : ndarray, shape (H, W, C)
        Image of the native size.
    squared : bool, optional
        Square the weights first.

    Returns
    -------
    ndarray, shape (N, C)
        ``sum_x w_n(x) image(x)``. Cost: one adjoint with respect to colours.
    """
    with dr.suspend_grad():
        types = types_of(gaussians.mean)
        lists = bin_gaussians(gaussians)
        delta = to_tiles(types, np.asarray(image, np.float32), lists.grid)
        shape = detached_shape(gaussians)
        product = apply_squared if squared else apply_transposed
        rows = product(shape, delta, image.shape[2], lists, gaussians.cutoff)
        return np.stack([row.numpy() for row in rows[0]], axis=1)


def apply(
    shape: list, x: Unknowns, lists: TileLists, cutoff: float, target: Float = None
) -> tuple[Any, list]:
    """Return ``A x - D``, and for each lane the sums of its squares."""
    packed = pack_parameters([*shape, *x[0]])
    return residual(packed, x[1], lists, kernel_radius(cutoff), target)


def apply_transposed(
    shape: list, delta: Float, channels: int, lists: TileLists, cutoff: float
) -> Unknowns:
    """Return ``A^T d``: correlations with every Gaussian, and the sum of every channel."""
    color = correlate(shape, delta, channels, lists, cutoff)
    return color, channel_sums(delta, channels, lists.grid)


def correlate(shape: list, delta: Float, channels: int, lists: TileLists, cutoff: float) -> list:
    """Return for each channel the correlations of an image with every Gaussian."""
    packed = pack_parameters([*shape, *[type(delta)(0)] * channels])
    return adjoint(packed, delta, channels, lists, kernel_radius(cutoff), color_only=True)


def inverse_diagonal(shape: list, channels: int, lists: TileLists, cutoff: float) -> Unknowns:
    """Return one over the diagonal of ``A^T A``: all channels have the same."""
    types = types_of(shape[0])
    packed = pack_parameters([*shape, types.Float(0)])
    ones = dr.full(types.Float, 1, lists.grid.images)
    inside, _ = residual(packed, [ones], lists, kernel_radius(cutoff), None)
    diagonal = apply_squared(shape, inside, 1, lists, cutoff)
    color, background = ([dr.select(d > 1e-8, rcp(d), 0) for d in part] for part in diagonal)
    return color * channels, background * channels


def apply_squared(
    shape: list, delta: Float, channels: int, lists: TileLists, cutoff: float
) -> Unknowns:
    """Apply `apply_transposed` with ``w^2``, the weight of a Gaussian narrower by sqrt 2."""
    root = math.sqrt(2)
    narrow = [*shape[:2], *[f * root for f in shape[2:NUM_SHAPE_PARAMS]]]
    reach = min(cutoff * root, MAX_CUTOFF)  # beyond, the squares are 0 in any precision
    return apply_transposed(narrow, delta, channels, replace(lists, steep=True), reach)


Unknowns = tuple[list, list]
"""Colours of all Gaussians and backgrounds of all images: a Float for each channel in both."""


def negate(x: Unknowns) -> Unknowns:
    """Return ``-x``."""
    return [-v for v in x[0]], [-v for v in x[1]]


def multiply(x: Unknowns, y: Unknowns) -> Unknowns:
    """Return the products of all entries."""
    color, background = (
        [a * b for a, b in zip(u, v, strict=True)] for u, v in zip(x, y, strict=True)
    )
    return color, background


def dots(x: Unknowns, y: Unknowns, grid: Grid) -> list:
    """Return the inner products for each channel, Floats of shape (images,)."""
    color, background = multiply(x, y)
    dr.eval(color)
    return [sum_by_image(c, grid) + b for c, b in zip(color, background, strict=True)]


def add_multiple(x: Unknowns, factors: list, y: Unknowns, image: Any) -> Unknowns:
    """Return ``x + factor y``; a factor has one value for each image, see `spread`."""
    color = [dr.fma(spread(f, image), b, a) for a, f, b in zip(x[0], factors, y[0], strict=True)]
    return color, [dr.fma(f, b, a) for a, f, b in zip(x[1], factors, y[1], strict=True)]


def spread(values: Float, image: Any) -> Any:
    """Return the value of the image of each entry; `image` is None if there is only one."""
    return values if image is None else dr.gather(type(values), values, image)

"""The best colours for fixed shapes: linear least squares by preconditioned conjugate gradients.

A rendering is linear in colours and background. Column n of the matrix ``A`` holds the weights of
Gaussian n at all pixels; the last column is 1. The best colours c minimise ``|A c - D|^2`` for the
image D. A rendering computes a product with A, an adjoint a product with its transpose; A is never
stored.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...backend.arithmetic import rcp
from ...backend.arrays import types_of
from ...backend.recording import freeze_program
from ...gaussian.file import MAX_CUTOFF
from ...gaussian.gaussians import Gaussians
from ...raster.kernels import adjoint, channel_sums, residual, sum_channels
from ...raster.layout import gather_run, pack_parameters
from ...raster.lists import TileLists
from ...raster.parameters import NUM_SHAPE_PARAMS, detached_shape, kernel_radius
from ...raster.render import bin_gaussians, to_tiles
from ...raster.tiles import Grid

RELATIVE_TOLERANCE = {32: 1e-12, 64: 1e-28}
"""Tolerance by the bits of a float: a channel stops if ``r^T z``, relative to its first value, is
smaller. A smaller ``r^T z`` is only rounding."""

ROUNDING = {32: 2e-7, 64: 4e-16}
"""Relative error of a correlation with a Gaussian, by the bits of a float. A channel with the error
e stops too if ``r^T z`` is below ``N ROUNDING^2 |e|^2``, which rounding alone reaches."""


class Solution(NamedTuple):
    """Result of `solve`.

    Attributes
    ----------
    gaussians : Gaussians
        The set with the new colours and background.
    residuals : list of float
        Root mean square of ``D - A c`` over pixels and channels, before the first step and after
        every step. It never grows, except by rounding.
    """

    gaussians: Gaussians
    residuals: list[float]


def solve(
    gaussians: Gaussians,
    image: NDArray[Any],
    steps: int = 10,
    warm_start: bool = False,
) -> Solution:
    """Find the colours and the background that fit an image best on fixed shapes.

    The method is conjugate gradients on the normal equations, for each channel separately, with
    their diagonal ``sum_x w_n(x)^2`` as preconditioner. A step costs one rendering and one adjoint
    with respect to colours.

    Parameters
    ----------
    gaussians : Gaussians
    image : ndarray, shape (H, W, C)
        Image of the native size, in the space of the set.
    steps : int, optional
        Number of steps. Few steps regularise the colours of Gaussians that overlap much.
    warm_start : bool, optional
        Start from the colours and background of the set instead of zero and the mean of the image.

    Returns
    -------
    Solution

    Raises
    ------
    ValueError
        If image and set differ in shape, or steps is negative.
    """
    expected = (gaussians.height, gaussians.width, gaussians.channels)
    if image.shape != expected:
        raise ValueError(f"solve: image has shape {image.shape}, the set needs {expected}")
    if steps < 0:
        raise ValueError(f"solve: steps is {steps}; it must be at least 0")
    with dr.suspend_grad():
        return _solve(gaussians, image, steps, warm_start)


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
        n = len(gaussians)
        lists = bin_gaussians(gaussians)
        delta = to_tiles(types, np.asarray(image, np.float32), lists.grid)
        shape = detached_shape(gaussians)
        product = _apply_squared if squared else _apply_transposed
        rows = product(shape, delta, image.shape[2], lists, gaussians.cutoff)
        return np.stack([row.numpy()[:n] for row in rows], axis=1)


def _solve(gaussians: Gaussians, image: NDArray[Any], steps: int, warm_start: bool) -> Solution:
    types = types_of(gaussians.mean)
    n, channels = len(gaussians), gaussians.channels
    lists, cutoff = bin_gaussians(gaussians), gaussians.cutoff
    shape = detached_shape(gaussians)
    if warm_start:
        x = [types.Float(c) + dr.zeros(types.Float, n) for c in gaussians.color]
        constant = [types.Float(b) for b in gaussians.background]
    else:
        x = [dr.zeros(types.Float, n) for _ in range(channels)]
        constant = [
            dr.opaque(types.Float, m) for m in image.mean(axis=(0, 1), dtype=np.float64).tolist()
        ]
    unknowns = [dr.concat([c, b]) for c, b in zip(x, constant, strict=True)]
    target = to_tiles(types, np.asarray(image, np.float32), lists.grid)
    dr.eval(shape, unknowns)

    error, squares = _apply(shape, unknowns, lists, cutoff, target)
    del target  # images are what takes memory here
    scale = 1 / image.size
    residuals = [sum(dr.sum(s) for s in squares) * scale]
    r = [-g for g in _apply_transposed(shape, error, channels, lists, cutoff)]
    inverse = _inverse_diagonal(shape, channels, lists, cutoff)
    p = [a * b for a, b in zip(r, inverse, strict=True)]
    rz = [dr.dot(a, b) for a, b in zip(r, p, strict=True)]
    enough = [RELATIVE_TOLERANCE[types.bits] * a for a in rz]
    noise = dr.opaque(types.Float, n * ROUNDING[types.bits] ** 2)
    dr.eval(p, rz, enough, residuals)
    with freeze_program(
        _step
    ) as take_step:  # for this solve only: a program does not notice another number of Gaussians
        for _ in range(steps):
            unknowns, error, p, rz, square = take_step(
                shape, unknowns, error, p, rz, enough, noise, inverse, lists, cutoff
            )
            residuals.append(square * scale)
    index = dr.arange(types.UInt, n)
    solved = replace(
        gaussians,
        color=types.FloatX([dr.gather(types.Float, u, index) for u in unknowns]),
        background=types.FloatX([dr.gather(types.Float, u, types.UInt(n)) for u in unknowns]),
    )
    dr.eval(solved)
    return Solution(solved, np.sqrt(dr.concat(residuals).numpy()).tolist())  # one copy to the host


def _step(
    shape: list,
    x: list,
    error: Any,
    p: list,
    rz: list,
    enough: list,
    noise: Any,
    inverse: list,
    lists: TileLists,
    cutoff: float,
) -> tuple:
    """Take one step of conjugate gradients for all channels; ``alpha = rz / |A p|^2``.

    The error is ``A x - D``; it costs one pass over two images.
    """
    Float = type(error)
    channels = len(x)
    q, squares = _apply(shape, p, lists, cutoff)
    dr.eval(squares)
    curvature = [dr.sum(s) for s in squares]
    # A channel that is solved except for rounding stops: its directions would grow without bound.
    alpha = [dr.select(k > 0, a / k, 0) for a, k in zip(rz, curvature, strict=True)]
    x = [dr.fma(a, d, v) for a, d, v in zip(alpha, p, x, strict=True)]
    error, squares = _add_scaled(error, q, alpha, lists.grid)
    r = [-g for g in _apply_transposed(shape, error, channels, lists, cutoff)]
    z = [a * b for a, b in zip(r, inverse, strict=True)]
    new_rz = [dr.dot(a, b) for a, b in zip(r, z, strict=True)]
    beta = [dr.select(a > 0, b / a, Float(0)) for a, b in zip(rz, new_rz, strict=True)]
    p = [
        dr.select(a > dr.maximum(least, noise * e), dr.fma(b, d, v), 0)
        for a, least, e, b, d, v in zip(new_rz, enough, squares, beta, p, z, strict=True)
    ]
    return x, error, p, new_rz, sum(squares)


def _add_scaled(image: Any, step: Any, factors: list, grid: Grid) -> tuple[Any, list]:
    """Return ``image + factor step`` by channels, in tile layout, and the sums of its squares."""
    types, channels = types_of(image), len(factors)
    tile, length = dr.arange(types.UInt, grid.tiles), grid.pixels * channels
    old, change = (gather_run(types, v, tile, length, True) for v in (image, step))
    scaled = zip(old, change, factors * grid.pixels, strict=True)
    new = [dr.fma(factor, c, v) for v, c, factor in scaled]
    result = dr.empty(types.Float, grid.tiles * length)
    dr.scatter(result, types.FloatX(new), tile)
    squares = sum_channels([dr.square(v) for v in new], channels)
    dr.eval(result, squares)
    return result, [dr.sum(s) for s in squares]


def _apply(
    shape: list, unknowns: list, lists: TileLists, cutoff: float, target: Any = None
) -> tuple[Any, list]:
    """Return ``A c - D`` and the sums of its squares; the last unknown is the background."""
    types = types_of(shape[0])
    n = dr.width(shape[0])
    color = [dr.gather(types.Float, u, dr.arange(types.UInt, n)) for u in unknowns]
    background = [dr.gather(types.Float, u, types.UInt(n)) for u in unknowns]
    packed = pack_parameters([*shape, *color])
    return residual(packed, background, lists, kernel_radius(cutoff), target)


def _apply_transposed(
    shape: list, delta: Any, channels: int, lists: TileLists, cutoff: float
) -> list:
    """Return ``A^T d``: correlations with every Gaussian and, last, the sum of every channel."""
    types = types_of(delta)
    packed = pack_parameters([*shape, *[types.Float(0)] * channels])
    color = adjoint(packed, delta, channels, lists, kernel_radius(cutoff), color_only=True)
    totals = channel_sums(delta, channels, lists.grid)
    return [dr.concat([c, t]) for c, t in zip(color, totals, strict=True)]


def _inverse_diagonal(shape: list, channels: int, lists: TileLists, cutoff: float) -> list:
    """Return one over the diagonal of ``A^T A``: all channels have the same."""
    types = types_of(shape[0])
    packed = pack_parameters([*shape, types.Float(0)])
    nothing = [types.Float(1)]
    inside, _ = residual(packed, nothing, lists, kernel_radius(cutoff), None)
    diagonal = _apply_squared(shape, inside, 1, lists, cutoff)[0]
    return [dr.select(diagonal > 1e-8, rcp(diagonal), 0)] * channels


def _apply_squared(shape: list, delta: Any, channels: int, lists: TileLists, cutoff: float) -> list:
    """Apply `_apply_transposed` with ``w^2``, the weight of a Gaussian narrower by sqrt 2."""
    root = math.sqrt(2)
    narrow = [*shape[:2], *[f * root for f in shape[2:NUM_SHAPE_PARAMS]]]
    reach = min(cutoff * root, MAX_CUTOFF)  # beyond, the squares are 0 in any precision
    return _apply_transposed(narrow, delta, channels, replace(lists, steep=True), reach)

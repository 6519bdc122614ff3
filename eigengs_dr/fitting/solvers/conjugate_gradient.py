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

from ...backend.arrays import types_of
from ...backend.recording import freeze_program
from ...gaussian.file import MAX_CUTOFF
from ...gaussian.gaussians import Gaussians
from ...raster.kernels import adjoint, channel_sums, forward
from ...raster.layout import pack_parameters
from ...raster.parameters import NUM_SHAPE_PARAMS, detached_shape, kernel_radius
from ...raster.render import bin_gaussians, to_tiles
from ...raster.tiles import TileLists

RELATIVE_TOLERANCE = {32: 1e-12, 64: 1e-28}
"""Tolerance by the bits of a float: a channel stops if ``r^T z``, relative to its first value, is
smaller. A smaller ``r^T z`` is only rounding."""


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
    lists = bin_gaussians(gaussians)
    inside = to_tiles(types, np.ones(image.shape, np.float32), lists.grid)
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
    dr.eval(shape, unknowns)

    residual = to_tiles(types, np.asarray(image, np.float32), lists.grid)
    residual -= _apply(shape, unknowns, lists, inside, gaussians.cutoff)
    scale = 1 / image.size
    squares = [dr.sum(dr.square(residual)) * scale]
    r = _apply_transposed(shape, residual, channels, lists, gaussians.cutoff)
    inverse = _inverse_diagonal(shape, inside, channels, lists, gaussians.cutoff)
    z = [a * b for a, b in zip(r, inverse, strict=True)]
    p, rz = z, [dr.dot(a, b) for a, b in zip(r, z, strict=True)]
    enough = [RELATIVE_TOLERANCE[types.bits] * a for a in rz]
    dr.eval(p, rz, enough)
    with freeze_program(
        _step
    ) as take_step:  # for this solve only: a program does not notice another number of Gaussians
        for _ in range(steps):
            unknowns, residual, p, rz, square = take_step(
                shape, unknowns, residual, p, rz, enough, inverse, inside, lists, gaussians.cutoff
            )
            squares.append(square * scale)
    index = dr.arange(types.UInt, n)
    solved = replace(
        gaussians,
        color=types.FloatX([dr.gather(types.Float, u, index) for u in unknowns]),
        background=types.FloatX([dr.gather(types.Float, u, types.UInt(n)) for u in unknowns]),
    )
    dr.eval(solved)
    return Solution(solved, [math.sqrt(float(s[0])) for s in squares])


def _step(
    shape: list,
    x: list,
    residual: Any,
    p: list,
    rz: list,
    enough: list,
    inverse: list,
    inside: Any,
    lists: TileLists,
    cutoff: float,
) -> tuple:
    """Take one step of conjugate gradients for all channels; ``alpha = rz / |A p|^2``."""
    Float = type(residual)
    channels = len(x)
    q = _apply(shape, p, lists, inside, cutoff)
    dr.eval(q)
    curvature = channel_sums(dr.square(q), channels, lists.grid)
    # A channel that is solved except for rounding stops: its directions would grow without bound.
    alpha = [dr.select(k > 0, a / k, 0) for a, k in zip(rz, curvature, strict=True)]
    x = [dr.fma(a, d, v) for a, d, v in zip(alpha, p, x, strict=True)]
    spread = dr.tile(dr.concat(alpha), lists.grid.tiles * lists.grid.pixels)
    residual = residual - spread * q
    dr.eval(residual)
    r = _apply_transposed(shape, residual, channels, lists, cutoff)
    z = [a * b for a, b in zip(r, inverse, strict=True)]
    new_rz = [dr.dot(a, b) for a, b in zip(r, z, strict=True)]
    beta = [dr.select(a > 0, b / a, Float(0)) for a, b in zip(rz, new_rz, strict=True)]
    p = [
        dr.select(a > least, dr.fma(b, d, v), 0)
        for a, least, b, d, v in zip(new_rz, enough, beta, p, z, strict=True)
    ]
    return x, residual, p, new_rz, dr.sum(dr.square(residual))


def _apply(shape: list, unknowns: list, lists: TileLists, inside: Any, cutoff: float) -> Any:
    """Return ``A c``: render the colours; the last unknown of a channel is its background."""
    types = types_of(shape[0])
    n = dr.width(shape[0])
    color = [dr.gather(types.Float, u, dr.arange(types.UInt, n)) for u in unknowns]
    background = [dr.gather(types.Float, u, types.UInt(n)) for u in unknowns]
    image = forward(pack_parameters([*shape, *color]), background, lists, kernel_radius(cutoff))
    return image * inside


def _apply_transposed(
    shape: list, delta: Any, channels: int, lists: TileLists, cutoff: float
) -> list:
    """Return ``A^T d``: correlations with every Gaussian and, last, the sum of every channel."""
    types = types_of(delta)
    packed = pack_parameters([*shape, *[types.Float(0)] * channels])
    color = adjoint(packed, delta, channels, lists, kernel_radius(cutoff), color_only=True)
    totals = channel_sums(delta, channels, lists.grid)
    return [dr.concat([c, t]) for c, t in zip(color, totals, strict=True)]


def _inverse_diagonal(
    shape: list, inside: Any, channels: int, lists: TileLists, cutoff: float
) -> list:
    """Return one over the diagonal of ``A^T A``."""
    diagonal = _apply_squared(shape, inside, channels, lists, cutoff)
    return [dr.select(d > 1e-8, dr.rcp(d), 0) for d in diagonal]


def _apply_squared(shape: list, delta: Any, channels: int, lists: TileLists, cutoff: float) -> list:
    """Apply `_apply_transposed` with ``w^2``, the weight of a Gaussian narrower by sqrt 2."""
    root = math.sqrt(2)
    narrow = [*shape[:2], *[f * root for f in shape[2:NUM_SHAPE_PARAMS]]]
    reach = min(cutoff * root, MAX_CUTOFF)  # beyond, the squares are 0 in any precision
    return _apply_transposed(narrow, delta, channels, lists, reach)

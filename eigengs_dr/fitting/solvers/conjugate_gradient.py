"""The best colours for fixed shapes: linear least squares by preconditioned conjugate gradients.

An image is linear in colours and background: with the matrix ``A`` whose column n holds the weights
of splat n at all pixels, and a last column of ones, the best colours minimise ``|A c - D|^2``. One
rendering is a product with A, one adjoint a product with its transpose; A is never stored.
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
"""Share of the first ``r^T z`` below which only rounding is left, by bits of a number."""


class Solution(NamedTuple):
    """Result of `solve`.

    Attributes
    ----------
    gaussians : Gaussians
        The set with the new colours and background.
    residuals : list of float
        Root mean square of ``D - A c`` over pixels and channels, before the first and after every
        step; it never grows but for rounding.
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

    Conjugate gradients on the normal equations, preconditioned by their diagonal
    ``sum_x w_n(x)^2``, each channel on its own. A step costs one rendering and one adjoint with
    respect to colours.

    Parameters
    ----------
    gaussians : Gaussians
    image : ndarray, shape (H, W, C)
        At the native size, in the space of the set.
    steps : int, optional
        Steps of the method; stopping early regularises where splats overlap much.
    warm_start : bool, optional
        Start from the colours and background of the set instead of zero and the image's mean.

    Returns
    -------
    Solution

    Raises
    ------
    ValueError
        If the image has another shape than the set, or steps is negative.
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
    """Inner products of every splat's weights with an image.

    Parameters
    ----------
    gaussians : Gaussians
        Its colours do not count.
    image : ndarray, shape (H, W, C)
        At the native size.
    squared : bool, optional
        Of the squares of the weights.

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
    ) as take_step:  # for this solve alone: a program does not notice another N
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
    """One step of conjugate gradients for all channels; ``alpha = rz / |A p|^2``."""
    Float = type(residual)
    channels = len(x)
    q = _apply(shape, p, lists, inside, cutoff)
    dr.eval(q)
    curvature = channel_sums(dr.square(q), channels, lists.grid)
    # What is solved but for rounding stays as it is: its directions would grow without bound.
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
    """``A c``: render the colours, the last unknown of a channel being its background."""
    types = types_of(shape[0])
    n = dr.width(shape[0])
    color = [dr.gather(types.Float, u, dr.arange(types.UInt, n)) for u in unknowns]
    background = [dr.gather(types.Float, u, types.UInt(n)) for u in unknowns]
    image = forward(pack_parameters([*shape, *color]), background, lists, kernel_radius(cutoff))
    return image * inside


def _apply_transposed(
    shape: list, delta: Any, channels: int, lists: TileLists, cutoff: float
) -> list:
    """``A^T d``: correlate with every splat, and the sum of every channel."""
    types = types_of(delta)
    packed = pack_parameters([*shape, *[types.Float(0)] * channels])
    color = adjoint(packed, delta, channels, lists, kernel_radius(cutoff), color_only=True)
    totals = channel_sums(delta, channels, lists.grid)
    return [dr.concat([c, t]) for c, t in zip(color, totals, strict=True)]


def _inverse_diagonal(
    shape: list, inside: Any, channels: int, lists: TileLists, cutoff: float
) -> list:
    """One over the diagonal of ``A^T A``."""
    diagonal = _apply_squared(shape, inside, channels, lists, cutoff)
    return [dr.select(d > 1e-8, dr.rcp(d), 0) for d in diagonal]


def _apply_squared(shape: list, delta: Any, channels: int, lists: TileLists, cutoff: float) -> list:
    """`_apply_transposed` for ``w^2``, the weight of a splat narrower by sqrt 2."""
    root = math.sqrt(2)
    narrow = [*shape[:2], *[f * root for f in shape[2:NUM_SHAPE_PARAMS]]]
    reach = min(cutoff * root, MAX_CUTOFF)  # beyond, squares are 0 in any precision
    return _apply_transposed(narrow, delta, channels, lists, reach)

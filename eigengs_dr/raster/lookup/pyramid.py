"""A pyramid of coarser sums of Gaussians on regular grids, for wide footprints.

A footprint that covers much of a texture covers many Gaussians, but the filtered texture is smooth
and needs few. On a grid of points p with the spacing h, with ``s = SAMPLE_DEVIATION * h``, the sum
blurred by the variance ``2 s^2`` is

    sum_p h^2 / (2 pi s^2) B(p) exp(-|x - p|^2 / (2 s^2)),

where B is the sum blurred by ``s^2`` in closed form. A lookup widens these Gaussians by the rest of
the variance of its footprint. The ripple of the grid is below
``2 exp(-2 (pi SAMPLE_DEVIATION)^2)`` = 5e-4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from ...backend.arrays import ArrayTypes, Bool, Float, UInt, rcp, rsqrt, types_of
from ..binning.lists import build_lists
from ..binning.tiles import Grid
from ..evaluate import falloff, widen
from ..parameters import (
    EXP2_SCALE,
    NUM_SHAPE_PARAMS,
    KernelParameters,
    gather_run,
    kernel_covariance,
    kernel_radius,
    unpack_parameters,
)
from ..render import rasterize, to_tensor
from .prefilter import sum_prefiltered
from .size_classes import FOOTPRINT_REACH, SizeClasses

SAMPLE_DEVIATION = 0.65
"""Standard deviation of the Gaussians of a level, in spacings of its points."""

SAMPLE_REACH = 3.0
"""Standard deviations at which the Gaussians of a level end."""


@dataclass(frozen=True)
class Level:
    """A regular grid of points.

    Attributes
    ----------
    first : int
        Index of its first point in `GaussianPyramid.values`.
    nx, ny : int
        Number of columns and rows of points.
    dx, dy : float
        Spacings in pixels.
    """

    first: int
    nx: int
    ny: int
    dx: float
    dy: float


@dataclass(frozen=True)
class GaussianPyramid:
    """Levels whose spacings are powers of two.

    Attributes
    ----------
    width, height : int
        Size of the image, in pixels.
    wrap : {"repeat", "mirror", "clamp"}
        Continuation of the image outside its borders.
    channels : int
        At most 4.
    levels : tuple of Level
        From fine to coarse.
    values : Float, shape (4 * points,)
        B at the points of all levels, row after row, 4 numbers per point; carries gradients.
    """

    width: int
    height: int
    wrap: str
    channels: int
    levels: tuple[Level, ...]
    values: Any


def count_points(level: Level) -> int:
    """Return the number of points of a level."""
    return level.nx * level.ny


def pyramid_mean(lattice: GaussianPyramid) -> list:
    """Return the mean of every channel over the image: a list of Float, shape (1,)."""
    types = types_of(lattice.values)
    level = lattice.levels[-1]
    rows = gather_run(
        types,
        lattice.values,
        dr.arange(types.UInt, count_points(level)) + level.first,
        4,
        True,
    )
    return [dr.mean(row) for row in rows[: lattice.channels]]


def is_minified(lattice: GaussianPyramid, footprint: list) -> Any:
    """Return whether a footprint is wide enough in all directions for the finest level.

    Parameters
    ----------
    footprint : list of 3 Float
        xx, xy, yy of the covariance, in pixels squared.

    Returns
    -------
    Bool
    """
    xx, xy, yy = footprint
    smallest = 0.5 * (xx + yy) - dr.sqrt(dr.fma(0.25 * (xx - yy), xx - yy, xy * xy))
    return smallest >= _min_variance(lattice.levels[0])


def _min_variance(level: Level) -> float:
    """Return the smallest variance of a footprint that a level can filter, in pixels squared."""
    return 2 * (SAMPLE_DEVIATION * max(level.dx, level.dy)) ** 2


def sum_pyramid(
    lattice: GaussianPyramid, x: Float, y: Float, footprint: list, active: Bool
) -> list:
    """Filter the sum by a footprint, on the coarsest level that is fine enough.

    Cost: one weight and one gather for each point inside the ellipse of `SAMPLE_REACH` standard
    deviations: 30 to 100 points times the ratio of its axes.

    Parameters
    ----------
    lattice : GaussianPyramid
    x, y : Float
        Centre of the footprint in the image, in pixels.
    footprint : list of 3 Float
        xx, xy, yy of the covariance, in pixels squared; `is_minified` must hold; not
        differentiated.
    active : Bool

    Returns
    -------
    list of Float
        One sum for each channel.
    """
    types = types_of(lattice.values)
    xx, xy, yy = (dr.detach(f) for f in footprint)
    smallest = 0.5 * (xx + yy) - dr.sqrt(dr.fma(0.25 * (xx - yy), xx - yy, xy * xy))
    first, nx, ny, dx, dy = _pick(types, lattice.levels, smallest)
    # In spacings of the level; the values are already blurred by SAMPLE_DEVIATION^2.
    u, v = x * rcp(dx) - 0.5, y * rcp(dy) - 0.5
    xx = dr.maximum(xx * dr.square(rcp(dx)) - SAMPLE_DEVIATION**2, SAMPLE_DEVIATION**2)
    yy = dr.maximum(yy * dr.square(rcp(dy)) - SAMPLE_DEVIATION**2, SAMPLE_DEVIATION**2)
    xy = xy * rcp(dx * dy)
    determinant = dr.maximum(dr.fma(xx, yy, -xy * xy), 1e-6)
    inverse = [k * rcp(determinant) * EXP2_SCALE**2 for k in (yy, -2 * xy, xx)]
    lean, free = xy * rcp(yy), determinant * rcp(yy)
    reach = SAMPLE_REACH * dr.sqrt(yy)
    scale = rsqrt(determinant) * (1 / (2 * math.pi * -math.expm1(-0.5 * SAMPLE_REACH**2)))

    def row_of(j: UInt) -> tuple:
        """Return the columns [i, stop] of the ellipse in one row of points."""
        down = types.Float(j) - dr.detach(v)
        half = dr.safe_sqrt(free * (SAMPLE_REACH**2 - down * down * rcp(yy)))
        middle = dr.fma(lean, down, dr.detach(u))
        return types.Int(dr.ceil(middle - half)), types.Int(dr.floor(middle + half))

    def add(i: UInt, stop: Any, j: UInt, u: Float, v: Any, sums: list) -> tuple:
        here = i <= stop
        across, down = types.Float(i) - u, types.Float(j) - v
        q = inverse[0] * across * across + (inverse[1] * across + inverse[2] * down) * down
        w = falloff(dr.maximum(q, 0), 2 * kernel_radius(SAMPLE_REACH) ** 2) * scale
        column, row = (_fold(types, k, n, lattice.wrap) for k, n in ((i, nx), (j, ny)))
        seen = gather_run(types, lattice.values, first + row * types.UInt(nx) + column, 4, here)
        sums = [dr.fma(w, c, s) for c, s in zip(seen, sums, strict=False)]
        i = i + 1
        ran = i > stop
        j = dr.select(ran, j + 1, j)
        begin, end = row_of(j)
        return dr.select(ran, begin, i), dr.select(ran, end, stop), j, u, v, sums

    last = types.Int(dr.select(active, dr.floor(dr.detach(v) + reach), -(2.0**30)))
    j = types.Int(dr.ceil(dr.detach(v) - reach))
    i, stop = row_of(j)
    return dr.while_loop(
        (i, stop, j, u, v, [types.Float(0) for _ in range(lattice.channels)]),
        lambda i, stop, j, *rest: j <= last,
        add,
        label="sum pyramid",
        mode="symbolic",
        max_iterations=-1,
    )[-1]


def _pick(types: ArrayTypes, levels: tuple[Level, ...], smallest: Any) -> list:
    """Return first, nx, ny, dx, dy of the coarsest level for footprints with this variance."""
    kinds = (types.UInt, types.Float, types.Float, types.Float, types.Float)
    rows = [(t.first, t.nx, t.ny, t.dx, t.dy) for t in levels]
    picked = [kind(number) for kind, number in zip(kinds, rows[0], strict=True)]
    for level, row in zip(levels[1:], rows[1:], strict=True):
        fits = smallest >= _min_variance(level)
        picked = [
            dr.select(fits, kind(number), before)
            for kind, number, before in zip(kinds, row, picked, strict=True)
        ]
    return picked


def _fold(types: ArrayTypes, index: UInt, count: Any, wrap: str) -> Any:
    """Move the index of a point into the level; points lie half a spacing inside the borders."""
    k = types.Float(index)
    if wrap == "repeat":
        return types.UInt(k - count * dr.floor((k + 0.5) * rcp(count)))
    k = k - 2 * count * dr.floor((k + 0.5) * rcp(2 * count))
    return types.UInt(dr.minimum(k, 2 * count - 1 - k))


FINEST, FEWEST = 1, 8
"""Spacing of the points of the finest level, in pixels (the points are the pixels), and smallest
number of points along the shorter side of the coarsest level."""


def build_pyramid(sizes: SizeClasses, packed: Float, number: int, cutoff: float) -> GaussianPyramid:
    """Evaluate a sum of Gaussians at the points of all levels; differentiable.

    Cost: a rendering of the blurred Gaussians for the finest level, and one
    `eigengs_dr.raster.lookup.prefilter.sum_prefiltered` for each of its points at a border. Each
    other level samples the previous level.

    Parameters
    ----------
    sizes, packed, number, cutoff
        As for `eigengs_dr.raster.lookup.prefilter.sum_prefiltered`.

    Returns
    -------
    GaussianPyramid
    """
    types = types_of(packed)
    width, height = sizes.width, sizes.height
    pyramid = GaussianPyramid(width, height, sizes.wrap, number - NUM_SHAPE_PARAMS, (), None)
    parts: list = []
    spacing = FINEST
    while not parts or min(width, height) >= FEWEST * spacing:
        nx, ny = math.ceil(width / spacing), math.ceil(height / spacing)
        level = Level(sum(map(count_points, pyramid.levels)), nx, ny, width / nx, height / ny)
        index = dr.arange(types.UInt, nx * ny)
        x = (types.Float(index % nx) + 0.5) * level.dx
        y = (types.Float(index // nx) + 0.5) * level.dy
        blur = [types.Float((SAMPLE_DEVIATION * level.dx) ** 2), types.Float(0)]
        blur.append(types.Float((SAMPLE_DEVIATION * level.dy) ** 2))
        if parts:
            finer = replace(pyramid, levels=(replace(pyramid.levels[-1], first=0),))
            seen = sum_pyramid(replace(finer, values=parts[-1]), x, y, blur, types.Bool(True))
        else:
            seen = _finest(sizes, packed, number, (x, y), blur, cutoff)
        parts.append(_interleaved(types, seen, nx * ny))
        pyramid = replace(pyramid, levels=(*pyramid.levels, level))
        spacing *= 2
    values = dr.concat(parts)
    dr.eval(values)
    return replace(pyramid, values=values)


def _finest(
    sizes: SizeClasses, packed: Float, number: int, points: tuple, blur: list, cutoff: float
) -> list:
    """Return the blurred sum at all pixels: widen all Gaussians once, and render them.

    At the border, copies of the image and the part of a Gaussian inside the image count too.
    """
    types = types_of(packed)
    width, height = sizes.width, sizes.height
    count = dr.width(packed) // (-(-number // 4) * 4)
    rows = unpack_parameters(packed, dr.arange(types.UInt, count), number)
    shape, amplitude = widen(rows[:NUM_SHAPE_PARAMS], kernel_covariance(blur))
    color = [amplitude * c for c in rows[NUM_SHAPE_PARAMS:]]
    grid, radius = Grid(width, height), kernel_radius(cutoff)
    fixed = [dr.detach(s) + dr.zeros(types.Float, count) for s in shape]
    lists = build_lists(fixed, radius, grid, adjoint=dr.grad_enabled(packed))
    parameters = KernelParameters(shape, color, [types.Float(0) for _ in color])
    image = to_tensor(rasterize(parameters, lists, cutoff), grid, len(color)).array
    x, y = points
    border = math.ceil(FOOTPRINT_REACH * SAMPLE_DEVIATION * FINEST)
    edge = (x < border) | (x > width - border) | (y < border) | (y > height - border)
    ring = dr.compress(edge)
    near = [dr.gather(types.Float, v, ring) for v in points]
    everywhere = types.Bool(True)
    seen = sum_prefiltered(sizes, packed, number, near[0], near[1], blur, everywhere, cutoff)
    dr.eval(seen)  # once for all channels
    index = dr.arange(types.UInt, width * height)
    result = []
    for k, part in enumerate(seen):
        whole = dr.zeros(types.Float, width * height)
        dr.scatter(whole, part, ring)
        inner = dr.gather(types.Float, image, index * len(color) + k)
        result.append(dr.select(edge, whole, inner))
    return result


def _interleaved(types: ArrayTypes, rows: list, count: int) -> Any:
    """Store the values of all channels point after point, 4 numbers per point."""
    padded = [*rows, *[types.Float(0)] * (4 - len(rows))]
    flat = dr.ravel(types.FloatX([row + dr.zeros(types.Float, count) for row in padded]), order="F")
    dr.eval(flat)
    return flat

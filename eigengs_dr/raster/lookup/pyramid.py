"""A pyramid of coarser sums of Gaussians on regular grids, for wide footprints.

A footprint that covers much of a texture covers many Gaussians, but the filtered texture is smooth
and needs few. On a grid of points p with the spacing h, with ``s = SAMPLE_DEVIATION * h``, the sum
blurred by the variance ``2 s^2`` is

    sum_p h^2 / (2 pi s^2) B(p) exp(-|x - p|^2 / (2 s^2)),

where B is the sum blurred by ``s^2`` in closed form. A lookup widens these Gaussians by the rest of
the variance of its footprint. The ripple of the grid is below
``2 exp(-2 (pi SAMPLE_DEVIATION)^2)`` = 5e-4 of Gaussians without ends, and with them up to 1 % for
the narrowest footprints, 0.4 % from 1.25 times their variance on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr

from ...backend.arrays import ArrayTypes, rcp, rsqrt, types_of
from ...backend.types import Bool, DrJitArray, Float, Mask, UInt
from ..evaluate import LN2, falloff
from ..parameters import (
    pack_parameters,
    unpack_parameters,
)
from .footprint import extreme_variances
from .points import Packed, axes_of
from .prefilter import sum_prefiltered
from .size_classes import SizeClasses

SAMPLE_DEVIATION = 0.65
"""Standard deviation of the Gaussians of a level, in spacings of its points."""

HALF = 16384.0
"""Largest value of a pyramid in half precision."""

SAMPLE_REACH = 3.0
"""Standard deviations at which the Gaussians of a level end."""

STEEPNESS, LIFT = 4.7, 0.078
"""With ``t = (r / SAMPLE_REACH)^2``, a Gaussian of a level at r standard deviations is

    exp(-STEEPNESS t) + LIFT t - (LIFT + exp(-STEEPNESS)) t^2.

It ends at 0: slopes of one that is cut off lack 5 %. These numbers bring its spectrum closest to
that of ``exp(-r^2 / 2)``, to 0.7 % where it was 1.1 % when cut off."""


@dataclass(frozen=True)
class Level:
    """A regular grid of points.

    Attributes
    ----------
    first : int
        Index of its first point in `GaussianPyramid.values`.
    nx, ny : int
        Number of columns and rows of points in the image.
    dx, dy : float
        Spacings in pixels.
    pad : int
        Number of columns and rows of points beyond each border.
    """

    first: int
    nx: int
    ny: int
    dx: float
    dy: float
    pad: int = 0

    @property
    def columns(self) -> int:
        """Number of columns with the padding."""
        return self.nx + 2 * self.pad

    @property
    def rows(self) -> int:
        """Number of rows with the padding."""
        return self.ny + 2 * self.pad


@dataclass(frozen=True)
class GaussianPyramid:
    """Levels whose spacings are powers of two.

    Attributes
    ----------
    wrap : {"repeat", "mirror", "clamp", "sphere"}
        Continuation of the image outside its borders.
    channels : int
    levels : tuple of Level
        From fine to coarse.
    values : Float or Float16, shape (points * stride,)
        B at the points of all levels, row after row, as from
        `eigengs_dr.raster.parameters.pack_parameters`; may carry gradients.
    scale : Float, shape (1,)
        Factor of the values.
    """

    wrap: str
    channels: int
    levels: tuple[Level, ...]
    values: Float
    scale: Float

    def gather(self, point: UInt, active: Mask = True) -> list:
        """Return the channels at points of the levels, but for the factor `scale`."""
        types = types_of(self.scale)
        rows = unpack_parameters(self.values, point, self.channels, active)
        return [types.Float(row) for row in rows]

    def halved(self) -> GaussianPyramid:
        """Return the pyramid in half precision; that of double precision stays as it is.

        A value has 11 bits, and a footprint averages 30 or more: the loss is smaller than a
        step of 8 bits. Values are scaled into the range of half precision.
        """
        types = types_of(self.scale)
        if types.bits == 64:
            return self
        largest = dr.max(dr.abs(self.values))
        scale = dr.select((largest > 0) & dr.isfinite(largest), largest * (1 / HALF), 1)
        values = dr.float16_array_t(types.Float)(self.values * rcp(scale))
        dr.eval(values, scale)
        return replace(self, values=values, scale=scale)


def pyramid_mean(lattice: GaussianPyramid) -> list:
    """Return the mean of every channel over the image: a list of Float, shape (1,)."""
    level, UInt = lattice.levels[-1], types_of(lattice.scale).UInt
    point = dr.arange(UInt, level.nx * level.ny)
    index = (point // level.nx + level.pad) * level.columns + point % level.nx + level.pad
    index += level.first
    return [lattice.scale * dr.mean(row) for row in lattice.gather(index)]


def is_minified(lattice: GaussianPyramid, footprint: list) -> Bool:
    """Return whether a footprint is wide enough in all directions for the finest level.

    Parameters
    ----------
    footprint : list of 3 Float
        xx, xy, yy of the covariance, in pixels squared.

    Returns
    -------
    Bool
    """
    return extreme_variances(footprint)[0] >= _min_variance(lattice.levels[0])


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
        xx, xy, yy of the covariance, in pixels squared; `is_minified` must hold.
    active : Bool

    Returns
    -------
    list of Float
        One sum for each channel.
    """
    types = types_of(lattice.scale)
    xx, xy, yy = footprint
    first, nx, ny, dx, dy = _pick(types, lattice.levels, extreme_variances(footprint)[0])
    pad = lattice.levels[0].pad
    # In spacings of the level; the values are already blurred by SAMPLE_DEVIATION^2.
    u, v = x * rcp(dx) - 0.5, y * rcp(dy) - 0.5
    xx = dr.maximum(xx * dr.square(rcp(dx)) - SAMPLE_DEVIATION**2, SAMPLE_DEVIATION**2)
    yy = dr.maximum(yy * dr.square(rcp(dy)) - SAMPLE_DEVIATION**2, SAMPLE_DEVIATION**2)
    xy = xy * rcp(dx * dy)
    determinant = dr.maximum(dr.fma(xx, yy, -xy * xy), 1e-6)
    steep = rcp(determinant) * (STEEPNESS / LN2 / SAMPLE_REACH**2)
    inverse = [k * steep for k in (yy, -2 * xy, xx)]
    lean, free, upright = dr.detach([xy * rcp(yy), determinant * rcp(yy), yy])
    reach = SAMPLE_REACH * dr.sqrt(upright)
    last, fall = STEEPNESS / LN2, LIFT + math.exp(-STEEPNESS)
    mass = -math.expm1(-STEEPNESS) / STEEPNESS + LIFT / 2 - fall / 3
    scale = rsqrt(determinant) * (1 / (math.pi * SAMPLE_REACH**2 * mass))

    def row_of(j: UInt) -> tuple:
        """Return the columns [i, stop] of the ellipse in one row of points."""
        down = types.Float(j) - dr.detach(v)
        half = dr.safe_sqrt(free * (SAMPLE_REACH**2 - down * down * rcp(upright)))
        middle = dr.fma(lean, down, dr.detach(u))
        return types.Int(dr.ceil(middle - half)), types.Int(dr.floor(middle + half))

    def add(i: UInt, stop: UInt, j: UInt, seen_from: tuple, sums: list) -> tuple:
        u, v, *moved = seen_from
        metric = moved or inverse
        here = i <= stop
        across, down = types.Float(i) - u, types.Float(j) - v
        q = metric[0] * across * across + (metric[1] * across + metric[2] * down) * down
        q = dr.clip(q, 0, last)
        w = dr.fma(q, dr.fma(-fall / last**2, q, LIFT / last), falloff(q))
        wrap_x, wrap_y = axes_of(lattice.wrap)
        column, row = _fold(types, i, nx, wrap_x), _fold(types, j, ny, wrap_y)
        point = first + row * types.UInt(nx + 2 * pad) + column
        seen = lattice.gather(point, here)
        sums = [dr.fma(w, c, s) for c, s in zip(seen, sums, strict=True)]
        i = i + 1
        ran = i > stop
        j = dr.select(ran, j + 1, j)
        begin, end = row_of(j)
        return dr.select(ran, begin, i), dr.select(ran, end, stop), j, seen_from, sums

    state = inverse if dr.grad_enabled(inverse) else []  # see `filtered_terms`
    bottom = types.Int(dr.select(active, dr.floor(dr.detach(v) + reach), -(2.0**30)))
    j = types.Int(dr.ceil(dr.detach(v) - reach))
    i, stop = row_of(j)
    sums = dr.while_loop(
        (i, stop, j, (u, v, *state), [types.Float(0) for _ in range(lattice.channels)]),
        lambda i, stop, j, *rest: j <= bottom,
        add,
        label="sum pyramid",
        mode="symbolic",
        max_iterations=-1,
    )[-1]
    return [lattice.scale * scale * s for s in sums]


def _pick(types: ArrayTypes, levels: tuple[Level, ...], smallest: Float) -> list:
    """Return first, nx, ny, dx, dy of the coarsest level for footprints with this variance."""
    kinds: list[type[DrJitArray]] = [types.UInt, *4 * [types.Float]]
    picked: list = []
    for level in levels:
        row = (level.first, level.nx, level.ny, level.dx, level.dy)
        values = [kind(number) for kind, number in zip(kinds, row, strict=True)]
        fits = smallest >= _min_variance(level)
        picked = [dr.select(fits, *v) for v in zip(values, picked or values, strict=True)]
    return picked


def _fold(types: ArrayTypes, index: UInt, count: Float, wrap: str) -> UInt:
    """Return the column of a point of the level; in the image, points lie half a spacing inside.

    Points beyond the padding of a clamped image have the values of the outermost ones.
    """
    if wrap == "clamp":
        return types.UInt(dr.clip(index, -PADDING, types.Int(count) + (PADDING - 1)) + PADDING)
    k = types.Float(index)
    if wrap == "repeat":
        return types.UInt(k - count * dr.floor((k + 0.5) * rcp(count)))
    k = k - 2 * count * dr.floor((k + 0.5) * rcp(2 * count))
    return types.UInt(dr.minimum(k, 2 * count - 1 - k))


FINEST, FEWEST = 1.0, 8
"""Smallest spacing of the points of the finest level, in pixels, and smallest number of points
along the shorter side of the coarsest level."""

POINTS = 3
"""Points of the finest level for each Gaussian. In half precision all levels then take 32 bytes for
each, as its parameters do."""


PADDING = 3
"""Points beyond each border of a clamped image. Three spacings outside, the blur of a level, of
`SAMPLE_DEVIATION`, sees 0.01 % of what lies inside: further out, values are constant."""


def levels_of(width: int, height: int, count: int, wrap: str) -> tuple[Level, ...]:
    """Return the levels of the pyramid of an image of `count` Gaussians."""
    levels: list[Level] = []
    spacing, first = math.sqrt(width * height / (POINTS * count)), 0
    spacing = max(FINEST, min(spacing, min(width, height) / FEWEST))
    pad = PADDING if wrap == "clamp" else 0
    while not levels or min(width, height) >= FEWEST * spacing:
        nx, ny = math.ceil(width / spacing), math.ceil(height / spacing)
        levels.append(Level(first, nx, ny, width / nx, height / ny, pad))
        first += levels[-1].columns * levels[-1].rows
        spacing *= 2
    return tuple(levels)


def _blur(types: ArrayTypes, level: Level) -> list:
    """Return the covariance xx, xy, yy by which the values of a level are blurred."""
    return [types.Float((SAMPLE_DEVIATION * d) ** 2) for d in (level.dx, 0, level.dy)]


def build_pyramid(sizes: SizeClasses, packed: Packed) -> GaussianPyramid:
    """Evaluate a sum of Gaussians at the points of all levels; differentiable.

    Cost: one `eigengs_dr.raster.lookup.prefilter.sum_prefiltered` for each point of the finest
    level. Each other level samples the previous level.
    """
    types, one = types_of(packed.values), types_of(packed.values).Float(1)
    levels = levels_of(sizes.width, sizes.height, sizes.cells.count, sizes.wrap)
    parts = list[Float]()
    for number, level in enumerate(levels):
        index = dr.arange(types.UInt, level.columns * level.rows)
        column, row = (
            types.Int(k) - level.pad for k in (index % level.columns, index // level.columns)
        )
        x, y = (types.Float(column) + 0.5) * level.dx, (types.Float(row) + 0.5) * level.dy
        blur, everywhere = _blur(types, level), types.Bool(True)
        if parts:
            finer = (replace(levels[number - 1], first=0),)
            pyramid = GaussianPyramid(sizes.wrap, packed.channels, finer, parts[-1], one)
            seen = sum_pyramid(pyramid, x, y, blur, everywhere)
        else:
            seen = sum_prefiltered(sizes, packed, x, y, blur, everywhere)
        parts.append(pack_parameters(seen))
        dr.eval(parts[-1])
    values = dr.concat(parts)
    dr.eval(values)
    return GaussianPyramid(sizes.wrap, packed.channels, levels, values, one)

"""Distant views of a sum of Gaussians: coarser sums of it, of few Gaussians on a regular lattice.

A footprint that covers much of a texture covers many splats. What it sees is smooth, and needs
few: with the spacing h, the sum blurred by ``2 (SIGMA h)^2`` is

    sum_p h^2 / (2 pi (SIGMA h)^2) B(p) exp(-|x - p|^2 / (2 (SIGMA h)^2)),

B being the sum blurred by ``(SIGMA h)^2``, in closed form, at the points p of the lattice. A lookup
widens these Gaussians by what its footprint has more. The ripple that the spacing leaves is below
``2 exp(-2 (pi SIGMA)^2)`` = 5e-4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from ...backend.arrays import ArrayTypes, types_of
from ..evaluate import falloff
from ..layout import gather_run
from ..parameters import EXP2_SCALE, NUM_SHAPE_PARAMS, kernel_radius
from .prefilter import sum_prefiltered
from .size_classes import SizeClasses

SAMPLE_DEVIATION = 0.65
"""Standard deviation of the lattice's Gaussians in units of its spacing."""

FINEST, FEWEST = 1, 8
"""Spacing of the finest lattice in pixels, and points along the shorter side of the coarsest."""

SAMPLE_REACH = 3.0
"""Standard deviations after which Gaussians of a lattice end."""


@dataclass(frozen=True)
class Level:
    """A lattice: its first value, numbers of points, and spacings in pixels."""

    first: int
    nx: int
    ny: int
    dx: float
    dy: float


@dataclass(frozen=True)
class GaussianPyramid:
    """Lattices of spacings of powers of two.

    Attributes
    ----------
    width, height : int
        Of the image.
    wrap : {"repeat", "mirror", "clamp"}
    channels : int
        At most 4.
    levels : tuple of Level
        From fine to coarse.
    values : Float
        B at all points, level after level, row after row, 4 numbers a point; carries gradients.
    """

    width: int
    height: int
    wrap: str
    channels: int
    levels: tuple[Level, ...]
    values: Any


def build_pyramid(sizes: SizeClasses, packed: Any, number: int, cutoff: float) -> GaussianPyramid:
    """Look a sum of Gaussians up at the points of all lattices, differentiably.

    Cost: one exact lookup for each of ``width height / FINEST^2`` points; coarser lattices come
    from finer ones.

    Parameters
    ----------
    sizes, packed, number, cutoff
        As in `eigengs_dr.raster.lookup.prefilter.sum_prefiltered`.
    """
    types = types_of(packed)
    width, height = sizes.width, sizes.height
    lattice = GaussianPyramid(width, height, sizes.wrap, number - NUM_SHAPE_PARAMS, (), None)
    parts: list = []
    spacing = FINEST
    while not parts or min(width, height) >= FEWEST * spacing:
        nx, ny = math.ceil(width / spacing), math.ceil(height / spacing)
        level = Level(sum(map(_points, lattice.levels)), nx, ny, width / nx, height / ny)
        index = dr.arange(types.UInt, nx * ny)
        x = (types.Float(index % nx) + 0.5) * level.dx
        y = (types.Float(index // nx) + 0.5) * level.dy
        blur = [types.Float((SAMPLE_DEVIATION * level.dx) ** 2), types.Float(0)]
        blur.append(types.Float((SAMPLE_DEVIATION * level.dy) ** 2))
        if parts:
            finer = replace(lattice, levels=(replace(lattice.levels[-1], first=0),))
            seen = sum_pyramid(replace(finer, values=parts[-1]), x, y, blur, types.Bool(True))
        else:
            seen = sum_prefiltered(sizes, packed, number, x, y, blur, types.Bool(True), cutoff)
        parts.append(_interleaved(types, seen, nx * ny))
        lattice = replace(lattice, levels=(*lattice.levels, level))
        spacing *= 2
    values = dr.concat(parts)
    dr.eval(values)
    return replace(lattice, values=values)


def _points(level: Level) -> int:
    return level.nx * level.ny


def _interleaved(types: ArrayTypes, rows: list, count: int) -> Any:
    """4 numbers a point, one point after another."""
    padded = [*rows, *[types.Float(0)] * (4 - len(rows))]
    flat = dr.ravel(types.FloatX([row + dr.zeros(types.Float, count) for row in padded]), order="F")
    dr.eval(flat)
    return flat


def pyramid_mean(lattice: GaussianPyramid) -> list:
    """Mean of every channel over the image."""
    types = types_of(lattice.values)
    level = lattice.levels[-1]
    rows = gather_run(
        types, lattice.values, dr.arange(types.UInt, _points(level)) + level.first, 4, True
    )
    return [dr.mean(row) for row in rows[: lattice.channels]]


def is_minified(lattice: GaussianPyramid, footprint: list) -> Any:
    """Where a footprint is wide enough in all directions for the finest lattice."""
    xx, xy, yy = footprint
    smallest = 0.5 * (xx + yy) - dr.sqrt(dr.fma(0.25 * (xx - yy), xx - yy, xy * xy))
    return smallest >= _min_variance(lattice.levels[0])


def _min_variance(level: Level) -> float:
    """Smallest variance of a footprint that a lattice serves."""
    return 2 * (SAMPLE_DEVIATION * max(level.dx, level.dy)) ** 2


def sum_pyramid(lattice: GaussianPyramid, x: Any, y: Any, footprint: list, active: Any) -> list:
    """Look a footprint up in the coarsest lattice that serves it.

    Parameters
    ----------
    lattice : Lattice
    x, y : Float
        Centre of the footprint in the image, in pixels.
    footprint : list of 3 Float
        xx, xy, yy of its covariance, in pixels squared, for which `is_minified` holds; not
        differentiated.
    active : Bool

    Returns
    -------
    list of Float
        Sums of the channels. Cost: a weight and a gather for each point of the lattice inside the
        ellipse of `SAMPLE_REACH` standard deviations, some 30 to 100 times the ratio of its axes.
    """
    types = types_of(lattice.values)
    xx, xy, yy = (dr.detach(f) for f in footprint)
    smallest = 0.5 * (xx + yy) - dr.sqrt(dr.fma(0.25 * (xx - yy), xx - yy, xy * xy))
    first, nx, ny, dx, dy = _pick(types, lattice.levels, smallest)
    # In units of the lattice, without the blur that its values have already.
    u, v = x * dr.rcp(dx) - 0.5, y * dr.rcp(dy) - 0.5
    xx = dr.maximum(xx * dr.square(dr.rcp(dx)) - SAMPLE_DEVIATION**2, SAMPLE_DEVIATION**2)
    yy = dr.maximum(yy * dr.square(dr.rcp(dy)) - SAMPLE_DEVIATION**2, SAMPLE_DEVIATION**2)
    xy = xy * dr.rcp(dx * dy)
    determinant = dr.maximum(dr.fma(xx, yy, -xy * xy), 1e-6)
    inverse = [k * dr.rcp(determinant) * EXP2_SCALE**2 for k in (yy, -2 * xy, xx)]
    lean, free = xy * dr.rcp(yy), determinant * dr.rcp(yy)
    reach = SAMPLE_REACH * dr.sqrt(yy)
    scale = dr.rsqrt(determinant) * (1 / (2 * math.pi * -math.expm1(-0.5 * SAMPLE_REACH**2)))

    def row_of(j: Any) -> tuple:
        """Columns [i, stop] of the ellipse in one row of the lattice."""
        down = types.Float(j) - dr.detach(v)
        half = dr.safe_sqrt(free * (SAMPLE_REACH**2 - down * down * dr.rcp(yy)))
        middle = dr.fma(lean, down, dr.detach(u))
        return types.Int(dr.ceil(middle - half)), types.Int(dr.floor(middle + half))

    def add(i: Any, stop: Any, j: Any, u: Any, v: Any, sums: list) -> tuple:
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
        label="sum lattice",
        mode="symbolic",
        max_iterations=-1,
    )[-1]


def _pick(types: ArrayTypes, levels: tuple[Level, ...], smallest: Any) -> list:
    """Numbers of the coarsest lattice that serves footprints with this smallest variance."""
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


def _fold(types: ArrayTypes, index: Any, count: Any, wrap: str) -> Any:
    """Bring the index of a point into the lattice, whose points lie half a spacing inside."""
    k = types.Float(index)
    if wrap == "repeat":
        return types.UInt(k - count * dr.floor((k + 0.5) * dr.rcp(count)))
    k = k - 2 * count * dr.floor((k + 0.5) * dr.rcp(2 * count))
    return types.UInt(dr.minimum(k, 2 * count - 1 - k))

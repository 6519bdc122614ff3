"""The sum of Gaussians seen through a Gaussian footprint: a prefilter in closed form.

A Gaussian convolved with a Gaussian is one again, so what a pixel sees of a texture is the sum of
widened splats (`eigengs_dr.splat.widen`): no mip map, no more samples. A texture ends at its
borders, or repeats: a splat then counts with the share of ``footprint x splat`` that lies in the
image, and copies of the image that the footprint reaches are summed as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from .arrays import types_of, upload
from .points import Cells, cell_side, list_cells, sum_near
from .splat import SHAPE, UNIT, gather_run, list_entry, unpack, weights, widen

WIDEST = 0.4
"""Largest standard deviation of a footprint, in widths and heights of the texture. One that is as
wide as this in all directions sees the mean: what it leaves of a repeating texture is below
``exp(-(2 pi WIDEST)^2 / 2)`` = 4 % of its coarsest wave."""

SMALLEST = 1.0
"""Largest standard deviation, in pixels, of the smallest size that splats are sorted by."""

RATIO = 3.0
"""Of one size to the next. More sizes are more rows to visit, fewer more splats in vain."""

SPREADS = (1.0, 4.0)
"""Footprints, in pixels, for which cells list their splats: where most lookups fall."""

REACH = 3.0
"""Standard deviations after which a footprint ends, where copies of the image are looked for."""


@dataclass(frozen=True)
class Sizes:
    """Splats sorted by size, and those of one size by the cell that holds their mean.

    A splat of the size s, its largest standard deviation being at most s, can only be seen by a
    footprint if its mean lies in the ellipse of ``footprint + s^2``: rows of cells of which each is
    one run of `splat`.

    Attributes
    ----------
    width, height : int
        Of the image.
    wrap : {"repeat", "mirror", "clamp"}
    count : int
        Number of sizes.
    splat : UInt32, shape (N,)
        Indices of splats: size after size, row after row, cell after cell.
    starts : UInt32, shape (cells + 1,)
        Where the splats of every cell begin in `splat`.
    table : Float, shape (8 count,)
        Of each size its square, first cell, columns, rows, 1 / side and origin of the cells.
    near : list of (float, Cells)
        Lists for points inside of the image and footprints of up to this standard deviation: those
        of splats widened by it, whose ellipses contain those of smaller footprints.
    """

    width: int
    height: int
    wrap: str
    count: int
    splat: Any
    starts: Any
    table: Any
    near: list


def sort_by_size(shape: list, width: int, height: int, cutoff: float, wrap: str) -> Sizes:
    """Sort splats for `sum_filtered`.

    Parameters
    ----------
    shape : list of 5 Float, shape (N,)
        Mean x, mean y and the factor a, b, c, as `eigengs_dr.splat.weights` takes them.
    width, height : int
        Of the image, in pixels.
    cutoff : float
        In standard deviations.
    wrap : {"repeat", "mirror", "clamp"}
    """
    types = types_of(shape[0])
    x, y, a, b, c = (np.asarray(s.numpy(), np.float64) for s in shape)
    with np.errstate(all="ignore"):
        size = _largest_deviation(a, b, c)
        drawn = np.isfinite(x + y + size) & (a > 0) & (c > 0)
        rank = np.ceil(np.log(size / SMALLEST) / math.log(RATIO))
    rank = np.where(drawn, np.maximum(rank, 0), 0).astype(np.int64)
    order, counts, table, first = [], [], [], 0
    for k in np.unique(rank[drawn]):
        own = np.flatnonzero(drawn & (rank == k))
        largest = float(size[own].max())
        # What is farther from the image leaves nothing in it.
        side = max(largest, max(width, height) / 1024)
        origin = -cutoff * largest
        columns, rows = (math.ceil((s - 2 * origin) / side) for s in (width, height))
        column, row = ((v[own] - origin) // side for v in (x, y))
        near = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        cell = (row * columns + column)[near].astype(np.int64)
        order.append(own[near][np.argsort(cell, kind="stable")])
        counts.append(np.bincount(cell, minlength=columns * rows))
        table.append([largest**2, first, columns, rows, 1 / side, origin, 0, 0])
        first += columns * rows
    starts = np.cumsum(np.concatenate([[0], *counts] if counts else [[0, 0]]))
    found = np.concatenate([*order, [0]])  # never empty, and even: it is read in pairs
    splat = np.pad(found, (0, len(found) % 2))
    return Sizes(
        width,
        height,
        wrap,
        len(table),
        upload(types.UInt, splat.astype(np.uint32)),
        upload(types.UInt, np.asarray(starts, np.uint32)),
        upload(types.Float, np.asarray(table or np.zeros((1, 8)), np.float32).ravel()),
        [(s, _cells_for(shape, width, height, cutoff, s)) for s in SPREADS],
    )


def _cells_for(shape: list, width: int, height: int, cutoff: float, spread: float) -> Cells:
    types = types_of(shape[0])
    variance = dr.opaque(types.Float, (spread / UNIT) ** 2)
    widened, _ = widen(shape, [variance, types.Float(0), variance])
    side = max(4, cell_side(width, height, dr.width(shape)))
    return list_cells(widened, width, height, UNIT * cutoff, side)


def _largest_deviation(a: Any, b: Any, c: Any) -> Any:
    """Largest standard deviation of splats with the factor ``[[a, b], [0, c]]`` over `UNIT`."""
    ia, t, ic = 1 / a, -b / (a * c), 1 / c
    middle = 0.5 * (ia * ia + t * t + ic * ic)
    root = np.sqrt(np.maximum(middle * middle - (ia * ic) ** 2, 0))
    return UNIT * np.sqrt(middle + root)


def bounded_covariance(metric: list) -> tuple[list, Any]:
    """Invert the metric of a footprint, with no axis longer than `WIDEST`.

    Of a symmetric 2x2 matrix M with eigenvalues p > q is
    ``f(M) = f(q) + (M - q) (f(p) - f(q)) / (p - q)``; here ``f(p) = 1 / max(p, WIDEST^-2)``.

    Parameters
    ----------
    metric : list of 3 Float
        xx, xy, yy of the inverse covariance of the footprint, in widths and heights of the texture.

    Returns
    -------
    covariance : list of 3 Float
        xx, xy, yy.
    blind : Bool
        Where the footprint is so wide in all directions that only the mean is left, or not finite.
    """
    xx, xy, yy = metric
    floor = 1 / WIDEST**2
    middle, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    root = dr.sqrt(dr.fma(half, half, xy * xy))
    p, q = middle + root, dr.maximum(middle - root, 0)
    blind = ~((p >= floor) & dr.isfinite(p))
    short, long = dr.rcp(dr.maximum(p, floor)), dr.rcp(dr.maximum(q, floor))
    slope = dr.select(root > 1e-6 * middle, (short - long) / (2 * root), 0)
    covariance = [dr.fma(slope, xx - q, long), slope * xy, dr.fma(slope, yy - q, long)]
    round_one = (WIDEST**2, 0.0, WIDEST**2)
    covariance = [dr.select(blind, r, c) for r, c in zip(round_one, covariance, strict=True)]
    return covariance, blind


def share(shape: list, footprint: list, x: Any, y: Any, width: int, height: int) -> Any:
    """What part of ``footprint x splat`` lies in the image.

    The product of both Gaussians is one with the mean ``x - Sigma_f Sigma'^-1 (x - mu)`` and the
    covariance ``Sigma_f - Sigma_f Sigma'^-1 Sigma_f``. Its mass in a rectangle is taken for the
    product of the masses in the two strips: exact but near corners.

    Parameters
    ----------
    shape : list of 5 Float
        Of the widened splat, from `widen`.
    footprint : list of 3 Float
        As in `widen`.
    x, y : Float
        Centre of the footprint.
    width, height : int
    """
    mean_x, mean_y, a, b, c = shape
    fxx, fxy, fyy = footprint
    dx, dy = x - mean_x, y - mean_y
    u, v = dr.fma(a, dx, b * dy), c * dy
    gx, gy = a * u, dr.fma(b, u, c * v)

    def strip(center: Any, along: Any, across: Any, other: Any, variance: Any, side: int) -> Any:
        left = dr.fma(a, along, b * across), c * across
        rest = dr.maximum(variance - dr.fma(left[0], left[0], left[1] * left[1]), 1e-6)
        steep = dr.rsqrt(rest) * (math.sqrt(0.5) / UNIT)
        middle = center - other
        return 0.5 * (quick_erf((side - middle) * steep) + quick_erf(middle * steep))

    shift_x, shift_y = dr.fma(fxx, gx, fxy * gy), dr.fma(fxy, gx, fyy * gy)
    return strip(x, fxx, fxy, shift_x, fxx, width) * strip(y, fxy, fyy, shift_y, fyy, height)


def quick_erf(x: Any) -> Any:
    """Error function to 0.005, at a fifth of the cost: the best odd polynomial that ends flat."""
    x = dr.clip(x, -2, 2)
    q = x * x
    p = dr.fma(dr.fma(dr.fma(-0.00595457, q, 0.07127595), q, -0.34688831), q, 1.12823041)
    return x * p


def sum_filtered(
    sizes: Sizes,
    packed: Any,
    number: int,
    x: Any,
    y: Any,
    footprint: list,
    active: Any,
    cutoff: float,
) -> list:
    """Sum the splats that a footprint sees.

    Parameters
    ----------
    sizes : Sizes
    packed, number
        As in `eigengs_dr.points.sum_near`.
    x, y : Float
        Centre of the footprint in the image, in pixels, see `eigengs_dr.points.fold`.
    footprint : list of 3 Float
        xx, xy, yy of its covariance, in pixels squared; not differentiated.
    active : Bool
    cutoff : float
        In standard deviations.

    Returns
    -------
    list of Float
        Sums of the channels. Cost: for every splat listed near the footprint in the image, and in
        each copy of the image that it reaches, a widening and a weight; where it reaches over a
        border, four error functions more.
    """
    types = types_of(packed)
    footprint = [dr.detach(f) for f in footprint]
    reach = [REACH * dr.safe_sqrt(footprint[k]) for k in (0, 2)]
    sides = (sizes.width, sizes.height)
    first = [dr.floor((v - r) * (1 / s)) for v, r, s in zip((x, y), reach, sides, strict=True)]
    last = [dr.floor((v + r) * (1 / s)) for v, r, s in zip((x, y), reach, sides, strict=True)]
    inner = (x >= reach[0]) & (x + reach[0] <= sides[0])
    inner &= (y >= reach[1]) & (y + reach[1] <= sides[1])
    widest = dr.maximum(*reach) * (1 / REACH)
    terms = _widened_values(footprint, (UNIT * cutoff) ** 2)
    total = [types.Float(0) for _ in range(number - SHAPE)]
    for spread, cells in sizes.near:
        small = active & inner & (widest <= spread)
        part = sum_near(cells, packed, number, x, y, small, terms, len(total))
        total = [t + p for t, p in zip(total, part, strict=True)]
        active = active & ~small
    lookup = _Lookup(sizes, packed, number, cutoff, footprint)
    copies = [types.Int(dr.detach(v)) for v in (*first, *last)]
    part = _sum_copies(lookup, x, y, copies, active)
    return [t + p for t, p in zip(total, part, strict=True)]


def _widened_values(footprint: list, limit: float) -> Any:
    """Terms of the sum seen through a footprint, inside the image; see `points.sum_near`."""
    scaled = [f * (1 / UNIT**2) for f in footprint]

    def terms(splat: list, x: Any, y: Any) -> list:
        shape, amplitude = widen(splat[:SHAPE], scaled)
        (w,) = weights(shape, x, y, (1, 1), limit)
        w = w * amplitude
        return [w * c for c in splat[SHAPE:]]

    return terms


@dataclass(frozen=True)
class _Lookup:
    """What both passes of one call share."""

    sizes: Sizes
    packed: Any
    number: int
    cutoff: float
    footprint: list


def _sum_copies(lookup: _Lookup, x: Any, y: Any, copies: list, active: Any) -> list:
    """Sum over the copies of the image from ``copies[:2]`` to ``copies[2:]``.

    Four loops in one, so that the lanes of a packet wait for the longest sum in total: over rows
    and columns of copies, sizes, rows of cells, and the run of splats in a row.
    """
    sizes, footprint, packed = lookup.sizes, lookup.footprint, lookup.packed
    types = types_of(packed)
    limit = (UNIT * lookup.cutoff) ** 2
    scaled = [f * (1 / UNIT**2) for f in footprint]
    left, top, right, bottom = copies
    bottom = dr.select(active, bottom, top - 1)

    def local(i: Any, j: Any, x: Any, y: Any) -> tuple:
        """Point in the copy (i, j), and the sign its mirroring gives to the footprint's xy."""
        x, y = x - types.Float(i) * sizes.width, y - types.Float(j) * sizes.height
        if sizes.wrap == "repeat":
            return x, y, types.Float(1)
        odd_x, odd_y = (i & 1) == 1, (j & 1) == 1
        x, y = dr.select(odd_x, sizes.width - x, x), dr.select(odd_y, sizes.height - y, y)
        return x, y, dr.select(odd_x == odd_y, types.Float(1), -1)

    def rows(i: Any, j: Any, k: Any) -> tuple:
        """Rows of cells [first, last] of the size k that the footprint sees."""
        square, _, _, ny, inverse, origin = _row_of(types, sizes, k)
        _, y0, _ = local(i, j, dr.detach(x), dr.detach(y))
        reach = lookup.cutoff * dr.sqrt(footprint[2] + square)
        first = dr.maximum(dr.floor((y0 - reach - origin) * inverse), 0)
        last = dr.minimum(dr.floor((y0 + reach - origin) * inverse), ny - 1)
        return types.Int(first), types.Int(last)

    def run(i: Any, j: Any, k: Any, row: Any, valid: Any) -> tuple:
        """Splats [begin, end) of one row of cells inside the ellipse of ``footprint + size^2``."""
        square, first, nx, _, inverse, origin = _row_of(types, sizes, k)
        x0, y0, sign = local(i, j, dr.detach(x), dr.detach(y))
        xx, xy, yy = footprint[0] + square, footprint[1] * sign, footprint[2] + square
        side = dr.rcp(inverse)
        low = dr.fma(types.Float(row), side, origin) - y0
        reach = lookup.cutoff * dr.sqrt(yy)
        low, high = dr.maximum(low, -reach), dr.minimum(low + side, reach)
        # At the height dy the ellipse reaches from m dy - h to m dy + h.
        lean, ratio = xy * dr.rcp(yy), dr.rcp(yy)
        free = dr.fma(-xy, lean, xx)
        peak = xy * dr.rsqrt(xx) * lookup.cutoff  # dy of the rightmost point

        def half(dy: Any) -> Any:
            return dr.safe_sqrt(free * (lookup.cutoff**2 - dy * dy * ratio))

        at_right, at_left = dr.clip(peak, low, high), dr.clip(-peak, low, high)
        begin = (x0 + lean * at_left - half(at_left) - origin) * inverse
        end = (x0 + lean * at_right + half(at_right) - origin) * inverse
        begin = types.Int(dr.clip(dr.floor(begin), 0, nx - 1))
        end = types.Int(dr.clip(dr.floor(end), 0, nx - 1))
        cell = types.Int(first) + row * types.Int(nx)
        valid = valid & (low <= high)
        return (
            dr.gather(types.UInt, sizes.starts, types.UInt(cell + begin), valid),
            dr.gather(types.UInt, sizes.starts, types.UInt(cell + end + 1), valid),
        )

    def add(
        n: Any, end: Any, row: Any, stop: Any, k: Any, i: Any, j: Any, x: Any, y: Any, sums: list
    ) -> tuple:
        here = (n < end) & (j <= bottom)
        index = list_entry(types, sizes.splat, n, here)
        splat = unpack(packed, index, lookup.number, here)
        px, py, sign = local(i, j, x, y)
        seen = [scaled[0], scaled[1] * sign, scaled[2]]
        shape, amplitude = widen(splat[:SHAPE], seen)
        (w,) = weights(shape, px, py, (1, 1), limit)
        part = share(shape, seen, px, py, sizes.width, sizes.height)
        w = dr.select(here, w * amplitude * part, 0)
        sums = [dr.fma(w, c, s) for c, s in zip(splat[SHAPE:], sums, strict=True)]
        n = n + 1
        ran = n >= end
        row = dr.select(ran, row + 1, row)
        k, i, j, fresh = _advance(ran & (row > stop), k, i, j, sizes.count, left, right)
        first, last = rows(i, j, k)
        row, stop = dr.select(fresh, first, row), dr.select(fresh, last, stop)
        begin, new_end = run(i, j, k, row, ran & (row <= stop) & (j <= bottom))
        return (
            dr.select(ran, begin, n),
            dr.select(ran, new_end, end),
            *(row, stop, k, i, j, x, y, sums),
        )

    k = types.Int(0) + dr.zeros(types.Int, dr.width(x))
    row, stop = rows(left, top, k)
    begin, end = run(left, top, k, row, active & (row <= stop))
    sums = [types.Float(0) for _ in range(lookup.number - SHAPE)]
    return dr.while_loop(
        (begin, end, row, stop, k, left, top, x, y, sums),
        lambda n, end, row, stop, k, i, j, *rest: j <= bottom,
        add,
        label="sum footprints",
        mode="symbolic",
        max_iterations=-1,
    )[-1]


def _advance(go: Any, k: Any, i: Any, j: Any, sizes: int, left: Any, right: Any) -> tuple:
    """Step to the next size, after the last to the next copy, after a row of copies to the next."""
    k = dr.select(go, k + 1, k)
    over = k >= sizes
    k, i = dr.select(over, 0, k), dr.select(over, i + 1, i)
    over = i > right
    return k, dr.select(over, left, i), dr.select(over, j + 1, j), go


def _row_of(types: Any, sizes: Sizes, k: Any) -> list:
    """Row k of the table of sizes."""
    return gather_run(types, sizes.table, types.UInt(k), 8, True)[:6]


def integrals(shape: list, width: int, height: int, cutoff: float) -> Any:
    """Share of the mean that each splat of unit colour has: its integral over the image's area.

    A splat that leaves the image counts with the product of the shares of its two marginals, and
    with ``1 - exp(-cutoff^2 / 2)``, what the cutoff leaves of it.
    """
    mean_x, mean_y, a, b, c = shape
    ia, ic = dr.rcp(a), dr.rcp(c)
    t = -b * ia * ic

    def inside(mean: Any, variance: Any, side: int) -> Any:
        steep = dr.rsqrt(variance) * (math.sqrt(0.5) / UNIT)
        return 0.5 * (dr.erf((side - mean) * steep) + dr.erf(mean * steep))

    area = (2 * math.pi * UNIT**2) * ia * ic * -math.expm1(-0.5 * cutoff**2)
    strips = inside(mean_x, dr.fma(ia, ia, t * t), width) * inside(mean_y, ic * ic, height)
    return area * strips * (1 / (width * height))

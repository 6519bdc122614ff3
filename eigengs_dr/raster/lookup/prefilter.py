"""The sum of Gaussians filtered by a Gaussian footprint, in closed form.

The convolution of two Gaussians is a Gaussian. Therefore a pixel sees the sum of widened Gaussians
(`eigengs_dr.raster.evaluate.widen`) and needs neither a mip map nor more samples. At the borders of
the image, a Gaussian is multiplied by the part of its product with the footprint that lies in the
image, and the sum includes all copies of the image that the footprint reaches.

A clamped image continues the centres of its outermost pixels: the plane has nine parts, the image
and one beyond each border and corner. Beyond a border a Gaussian is constant across it, hence seen
from the border with the footprint's width along the border alone, times the share of the footprint
that lies there. Like the shares inside of the image this is exact but for the error of
`eigengs_dr.raster.lookup.footprint.quick_erf`, and near corners for footprints that lean.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr

from ...backend.arrays import rcp, rsqrt, types_of
from ...backend.types import Bool, Float, UInt
from ..evaluate import weights, widen_inverted
from ..parameters import gather_index, kernel_covariance, unpack_parameters
from .footprint import extreme_variances, filtered_terms, inside_share
from .points import Packed, axes_of, sum_range
from .size_classes import FOOTPRINT_REACH, SizeClasses

FAR = 1e9
"""End in pixels of the parts of the plane beyond the borders of a clamped image."""


def sum_prefiltered(
    sizes: SizeClasses, packed: Packed, x: Float, y: Float, footprint: list, active: Bool
) -> list:
    """Sum the Gaussians under a footprint.

    Cost: one `widen` and one weight for each Gaussian near the footprint, in the image and in each
    copy that the footprint reaches; four error functions more if it crosses a border.

    Parameters
    ----------
    sizes : SizeClasses
    packed : Packed
        Rows from `eigengs_dr.raster.lookup.points.invert`.
    x, y : Float
        Centre of the footprint in pixels, moved into the image by
        `eigengs_dr.raster.lookup.points.fold`, or near it by `near_image` if that is clamped.
    footprint : list of 3 Float
        xx, xy, yy of the covariance, in pixels squared.
    active : Bool

    Returns
    -------
    list of Float
        One sum for each channel.
    """
    reach, sides = _reach(footprint), (sizes.width, sizes.height)
    bounds = [
        [_part(sizes, dr.detach(v) + k, side) for k in (-r, r)]
        for v, r, side in zip((x, y), reach, sides, strict=True)
    ]
    near, seen = (x, y), footprint
    if sizes.wrap == "clamp":
        near, seen = _at_borders(sizes, (x, y), footprint)
        reach = _reach(seen)
    widest = dr.safe_sqrt(extreme_variances(seen)[1])
    listed = active & (widest <= sizes.spreads[-1])
    for v, r, side in zip(near, reach, sides, strict=True):
        first, last = _ends(sizes, side)
        listed &= (v >= first + r) & (v + r <= last)
    ends = _shortest_list(sizes, *near, widest, listed)
    terms, shared = filtered_terms(packed, seen)
    total = sum_range(sizes.cells, ends, packed, *near, terms, shared=shared)
    rest = active & ~listed
    part = where_any(
        rest,
        lambda: _sum_copies(sizes, packed, x, y, footprint, bounds, rest),
        [types_of(x).Float(0)] * packed.channels,
        (packed.values, x, y, *footprint),
    )
    return [t + p for t, p in zip(total, part, strict=True)]


def _shortest_list(
    sizes: SizeClasses, x: Float, y: Float, widest: Float, active: Bool
) -> tuple[UInt, UInt]:
    """Return begin and end of the shortest list that serves a footprint."""
    types = types_of(x)
    begin, end = types.UInt(0), types.UInt(0)
    for spread, cells in zip(sizes.spreads, sizes.cells.levels, strict=True):
        small = active & (widest <= spread)
        bounds = sizes.cells.range_at(cells, dr.detach(x), dr.detach(y), small)
        begin, end = dr.select(small, bounds[0], begin), dr.select(small, bounds[1], end)
        active = active & ~small
    return begin, end


def where_any(
    active: Bool, compute: Callable[[], list], others: list, inputs: tuple[Float, ...]
) -> list:
    """Return values that few points need, and skip the work for packets of lanes without one.

    Parameters
    ----------
    active : Bool
        The points that need the values.
    compute : callable
        Returns the values.
    others : list of Float
        The values of other points.
    inputs : tuple of Float
        All that `compute` reads and that may have derivatives. If one of them has, nothing is
        skipped: Dr.Jit cannot carry derivatives out of the branch.
    """
    if dr.grad_enabled(inputs):
        return compute()
    return list(
        dr.if_stmt((), active, lambda: tuple(compute()), lambda: tuple(others), mode="symbolic")
    )


def _ends(sizes: SizeClasses, side: int) -> tuple[float, float]:
    """Return where the image ends along an axis."""
    return (0.5, side - 0.5) if sizes.wrap == "clamp" else (0.0, float(side))


def _reach(footprint: list) -> list:
    """Return how far a footprint reaches along x and y."""
    return [FOOTPRINT_REACH * dr.safe_sqrt(dr.detach(footprint[k])) for k in (0, 2)]


def _at_borders(sizes: SizeClasses, point: tuple, footprint: list) -> tuple[Any, list]:
    """Move footprints that lie beyond a border of a clamped image to it.

    Without their width across the border they see the same, and the lists of cells cover it.
    """
    xx, xy, yy = footprint
    moved, inside = [], []
    sides = sizes.width, sizes.height
    for v, reach, side in zip(point, _reach(footprint), sides, strict=True):
        first, last = _ends(sizes, side)
        inside.append((v + reach >= first) & (v - reach <= last))
        moved.append(dr.select(inside[-1], v, dr.clip(v, first, last)))
    (x, y) = inside
    return moved, [dr.select(x, xx, 0), dr.select(x & y, xy, 0), dr.select(y, yy, 0)]


def _part(sizes: SizeClasses, v: Float, side: int) -> Any:
    """Return the number of the copy at a coordinate; for a clamped image -1, 0 or 1."""
    Int = types_of(v).Int
    if sizes.wrap != "clamp":
        return Int(dr.floor(v * (1 / side)))
    first, last = _ends(sizes, side)
    return dr.select(v > last, Int(1), dr.select(v < first, Int(-1), 0))


def _share(
    sizes: SizeClasses, shape: list, footprint: list, place: tuple, at: tuple, center: tuple
) -> Float:
    """Return the share in the part (i, j) of the plane of the footprint times a Gaussian."""
    types = types_of(center[0])
    spans, free = [], []
    for k, side in zip(place, (sizes.width, sizes.height), strict=True):
        first, last = _ends(sizes, side)
        if sizes.wrap == "clamp":
            low = dr.select(k < 0, types.Float(-FAR), dr.select(k > 0, types.Float(last), first))
            high = dr.select(k < 0, types.Float(first), dr.select(k > 0, types.Float(FAR), last))
            spans.append((low, high))
            free.append(dr.select(k == 0, types.Float(1), 0))
        else:
            spans.append((first, last))
            free.append(types.Float(1))
    return inside_share(shape, footprint, center, spans, at, free)


def _local(sizes: SizeClasses, i: UInt, j: UInt, x: Float, y: Float) -> tuple:
    """Return the point in the copy (i, j), and factors of the footprint's xx, xy, yy there."""
    types = types_of(x)
    if sizes.wrap == "clamp":
        (left, right), (top, bottom) = (_ends(sizes, n) for n in (sizes.width, sizes.height))
        fx, fy = (dr.select(k == 0, types.Float(1), 0) for k in (i, j))
        x = dr.select(i == 0, x, dr.select(i < 0, types.Float(left), right))
        y = dr.select(j == 0, y, dr.select(j < 0, types.Float(top), bottom))
        return x, y, (fx, fx * fy, fy)
    one = types.Float(1)
    x, y = x - types.Float(i) * sizes.width, y - types.Float(j) * sizes.height
    if sizes.wrap == "repeat":
        return x, y, (one, one, one)
    odd_x, odd_y = (
        (k & 1) == 1 if way == "mirror" else types.Bool(False)
        for k, way in zip((i, j), axes_of(sizes.wrap), strict=True)
    )
    x, y = dr.select(odd_x, sizes.width - x, x), dr.select(odd_y, sizes.height - y, y)
    return x, y, (one, dr.select(odd_x == odd_y, one, -1), one)


def _sum_copies(
    sizes: SizeClasses,
    packed: Packed,
    x: Float,
    y: Float,
    footprint: list,
    bounds: list,
    active: Bool,
) -> list:
    """Sum over the copies of the image between the `bounds` along x and along y.

    One loop covers the copies, the size classes, the rows of cells and the Gaussians of a row:
    lanes of a packet then wait once for the longest sum.
    """
    types, cutoff = types_of(packed.values), packed.cutoff
    (left, right), (top, bottom) = bounds
    crosses = (left < right) | (top < bottom)
    bottom = dr.select(active, bottom, top - 1)
    classes = dr.width(sizes.table) // 8

    def next_run(fresh: Bool, row: UInt, stop: UInt, place: tuple, valid: Bool) -> tuple:
        """Return the range [begin, end) in `sizes.row` of a row of cells, the row and the last one.

        Where `fresh`, the row is the first one of the size class under the footprint.
        """
        k, i, j = place
        square, cells, nx, ny, inverse, origin = unpack_parameters(sizes.table, types.UInt(k), 6)
        x0, y0, factors = _local(sizes, i, j, dr.detach(x), dr.detach(y))
        xx, xy, yy = (dr.detach(f) * k for f, k in zip(footprint, factors, strict=True))
        xx, yy = xx + square, yy + square
        reach = cutoff * dr.sqrt(yy)
        first = types.Int(dr.maximum(dr.floor((y0 - reach - origin) * inverse), 0))
        last = types.Int(dr.minimum(dr.floor((y0 + reach - origin) * inverse), ny - 1))
        row, stop = dr.select(fresh, first, row), dr.select(fresh, last, stop)
        side = rcp(inverse)
        low = dr.fma(types.Float(row), side, origin) - y0
        low, high = dr.maximum(low, -reach), dr.minimum(low + side, reach)
        # At height dy the ellipse of footprint + size^2 spans lean * dy - half to lean * dy + half.
        lean, ratio = xy * rcp(yy), rcp(yy)
        free = dr.fma(-xy, lean, xx)
        peak = xy * rsqrt(xx) * cutoff  # dy of the rightmost point

        def half(dy: Float) -> Float:
            return dr.safe_sqrt(free * (cutoff**2 - dy * dy * ratio))

        at_right, at_left = dr.clip(peak, low, high), dr.clip(-peak, low, high)
        left_end = (x0 + lean * at_left - half(at_left) - origin) * inverse
        right_end = (x0 + lean * at_right + half(at_right) - origin) * inverse
        begin, end = (
            types.Int(cells) + row * types.Int(nx) + types.Int(dr.clip(dr.floor(v), 0, nx - 1))
            for v in (left_end, right_end)
        )
        valid = valid & (row <= stop) & (j <= bottom) & (low <= high)
        begin, end = (
            dr.gather(types.UInt, sizes.starts, types.UInt(v), valid) for v in (begin, end + 1)
        )
        return begin, end, row, stop

    def advance(n: UInt, end: UInt, row: UInt, stop: UInt, place: tuple) -> tuple:
        """Go to the next row of cells; few Gaussians are the last ones of a row.

        After the last row comes the next size class, then the next copy, then the next row of
        copies.
        """
        row = row + 1
        fresh = row > stop
        k, i, j = place
        k = dr.select(fresh, k + 1, k)
        k, i = dr.select(k >= classes, 0, k), dr.select(k >= classes, i + 1, i)
        i, j = dr.select(i > right, left, i), dr.select(i > right, j + 1, j)
        return *next_run(fresh, row, stop, (k, i, j), types.Bool(True)), (k, i, j)

    def add(
        n: UInt, end: UInt, row: UInt, stop: UInt, place: tuple, seen_from: tuple, sums: list
    ) -> tuple:
        (_, i, j), (x, y, *scaled) = place, seen_from
        here = (n < end) & (j <= bottom)
        shape, color = packed.gather(gather_index(types, sizes.row, n, here), here)
        px, py, factors = _local(sizes, i, j, x, y)
        seen = [f * k for f, k in zip(scaled, factors, strict=True)]
        # On a clamped image, the whole footprint decides how much of it lies in each part.
        metric, center = (scaled, (x, y)) if sizes.wrap == "clamp" else (seen, (px, py))
        shape, amplitude = widen_inverted(shape, seen)
        (w,) = weights(shape, px, py, (1, 1), packed.radius)
        (part,) = where_any(
            crosses,
            lambda: [_share(sizes, shape, metric, (i, j), (px, py), center)],
            [types.Float(1)],
            (packed.values, *seen_from),
        )
        w = dr.select(here, w * amplitude * part, 0)
        sums = [dr.fma(w, c, s) for c, s in zip(color, sums, strict=True)]
        n = n + 1
        state = n, end, row, stop, place
        state = dr.if_stmt(state, n >= end, advance, lambda *same: same, mode="symbolic")
        return *state, seen_from, sums

    zero = dr.zeros(types.Int, dr.width(x))
    start = next_run(types.Bool(True), zero, zero, (zero, left, top), active)
    sums = [types.Float(0) for _ in range(packed.channels)]
    return dr.while_loop(
        (*start, (zero, left, top), (x, y, *kernel_covariance(footprint)), sums),
        lambda n, end, row, stop, place, *rest: place[2] <= bottom,
        add,
        label="sum footprints",
        mode="symbolic",
        max_iterations=-1,
    )[-1]

"""The sum of Gaussians filtered by a Gaussian footprint, in closed form.

The convolution of two Gaussians is a Gaussian. Therefore a pixel sees the sum of widened Gaussians
(`eigengs_dr.raster.evaluate.widen`) and needs neither a mip map nor more samples. At the borders of
the image, a Gaussian is multiplied by the part of its product with the footprint that lies in the
image, and the sum includes all copies of the image that the footprint reaches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from ...backend.arrays import Bool, Float, UInt, rcp, rsqrt, types_of
from ..evaluate import weights, widen
from ..parameters import (
    NUM_SHAPE_PARAMS,
    gather_index,
    gather_run,
    kernel_covariance,
    kernel_radius,
    unpack_parameters,
)
from .footprint import arranged_values, inside_share, widened_values
from .points import cell_range, sum_range
from .size_classes import FOOTPRINT_REACH, SizeClasses


def sum_prefiltered(
    sizes: SizeClasses,
    packed: Float,
    number: int,
    x: Float,
    y: Float,
    footprint: list,
    active: Bool,
    cutoff: float,
    arranged: Float = None,
) -> list:
    """Sum the Gaussians under a footprint.

    Cost: one `widen` and one weight for each Gaussian near the footprint, in the image and in each
    copy that the footprint reaches; four error functions more if it crosses a border.

    Parameters
    ----------
    sizes : SizeClasses
    packed, number
        As for `eigengs_dr.raster.lookup.points.sum_at_points`.
    x, y : Float
        Centre of the footprint in pixels, moved into the image by
        `eigengs_dr.raster.lookup.points.fold`.
    footprint : list of 3 Float
        xx, xy, yy of the covariance, in pixels squared; not differentiated.
    active : Bool
    cutoff : float
        Standard deviations.
    arranged : Float, optional
        From `arrange`, for lookups without gradients.

    Returns
    -------
    list of Float
        One sum for each channel.
    """
    types = types_of(packed)
    footprint = [dr.detach(f) for f in footprint]
    reach = [FOOTPRINT_REACH * dr.safe_sqrt(footprint[k]) for k in (0, 2)]
    sides = (sizes.width, sizes.height)
    first = [dr.floor((v - r) * (1 / s)) for v, r, s in zip((x, y), reach, sides, strict=True)]
    last = [dr.floor((v + r) * (1 / s)) for v, r, s in zip((x, y), reach, sides, strict=True)]
    inner = (x >= reach[0]) & (x + reach[0] <= sides[0])
    inner &= (y >= reach[1]) & (y + reach[1] <= sides[1])
    widest = dr.maximum(*reach) * (1 / FOOTPRINT_REACH)
    channels = number - NUM_SHAPE_PARAMS
    listed = active & (widest <= sizes.listed[-1][0])
    radius = kernel_radius(cutoff)
    terms = (widened_values if arranged is None else arranged_values)(footprint, radius)
    splat, ends = sizes.listed[0][1].splat, _ends(sizes, x, y, widest, listed & inner)
    total = sum_range(splat, ends, packed, number, x, y, terms, channels, arranged)
    # Two copies in each direction: more only show in small images.
    listed &= (last[0] - first[0] <= 1) & (last[1] - first[1] <= 1)
    lookup = _Lookup(sizes, packed, number, cutoff, footprint)
    copies = [types.Int(dr.detach(v)) for v in (*first, *last)]
    border = listed & ~inner
    others = active & ~border & ~(inner & (widest <= sizes.listed[-1][0]))
    for few, compute in (
        (border, lambda: _sum_border(lookup, x, y, copies, widest, border)),
        (others, lambda: _sum_copies(lookup, x, y, copies, others)),
    ):
        part = where_any(few, compute, channels, packed)
        total = [t + p for t, p in zip(total, part, strict=True)]
    return total


def _ends(sizes: SizeClasses, x: Float, y: Float, widest: Any, active: Bool) -> tuple[Any, Any]:
    """Return begin and end of the shortest list that serves a footprint."""
    types = types_of(x)
    begin, end = types.UInt(0), types.UInt(0)
    for spread, cells in sizes.listed:
        small = active & (widest <= spread)
        found = cell_range(cells, x, y, small)
        begin, end = dr.select(small, found[0], begin), dr.select(small, found[1], end)
        active = active & ~small
    return begin, end


def where_any(active: Bool, compute: Callable[[], list], count: int, packed: Float) -> list:
    """Return sums that few points need, and skip the work for packets of lanes without one.

    Parameters
    ----------
    active : Bool
        The points that need the sums; the others get 0.
    compute : callable
        Returns the sums, a list of Float.
    count : int
        Length of this list.
    packed : Float
        Parameters. With gradients nothing is skipped: Dr.Jit cannot carry them out of the branch.
    """
    if dr.grad_enabled(packed):
        return compute()
    types = types_of(packed)
    return list(
        dr.if_stmt(
            (),
            active,
            lambda: tuple(compute()),
            lambda: tuple(types.Float(0) for _ in range(count)),
            mode="symbolic",
        )
    )


@dataclass(frozen=True)
class _Lookup:
    """Arguments of `sum_prefiltered` that `_sum_copies` needs."""

    sizes: SizeClasses
    packed: Any
    number: int
    cutoff: float
    footprint: list


def _local(sizes: SizeClasses, i: UInt, j: UInt, x: Float, y: Float) -> tuple:
    """Return the point in the copy (i, j), and the sign of the footprint's xy in this copy."""
    types = types_of(x)
    x, y = x - types.Float(i) * sizes.width, y - types.Float(j) * sizes.height
    if sizes.wrap == "repeat":
        return x, y, types.Float(1)
    odd_x, odd_y = (i & 1) == 1, (j & 1) == 1
    x, y = dr.select(odd_x, sizes.width - x, x), dr.select(odd_y, sizes.height - y, y)
    return x, y, dr.select(odd_x == odd_y, types.Float(1), -1)


def _sum_border(
    lookup: _Lookup, x: Float, y: Float, copies: list, widest: Any, active: Bool
) -> list:
    """Sum over the lists of up to 2 x 2 copies of the image, for small footprints."""
    sizes, packed = lookup.sizes, lookup.packed
    types, channels = types_of(packed), lookup.number - NUM_SHAPE_PARAMS
    radius, scaled = kernel_radius(lookup.cutoff), kernel_covariance(lookup.footprint)
    left, top, right, bottom = copies
    total = [types.Float(0) for _ in range(channels)]
    for i, j, shown in (
        (left, top, active),
        (right, top, active & (right != left)),
        (left, bottom, active & (bottom != top)),
        (right, bottom, active & (right != left) & (bottom != top)),
    ):
        px, py, sign = _local(sizes, i, j, x, y)
        seen = [scaled[0], scaled[1] * sign, scaled[2]]

        def terms(splat: list, x: Float, y: Float, seen: list = seen) -> list:
            shape, amplitude = widen(splat[:NUM_SHAPE_PARAMS], seen)
            (w,) = weights(shape, x, y, (1, 1), radius)
            w = w * amplitude * inside_share(shape, seen, x, y, sizes.width, sizes.height)
            return [w * c for c in splat[NUM_SHAPE_PARAMS:]]

        ends = _ends(sizes, dr.detach(px), dr.detach(py), widest, shown)
        splat = sizes.listed[0][1].splat
        part = sum_range(splat, ends, packed, lookup.number, px, py, terms, channels)
        total = [t + p for t, p in zip(total, part, strict=True)]
    return total


def _sum_copies(lookup: _Lookup, x: Float, y: Float, copies: list, active: Bool) -> list:
    """Sum over the copies of the image from ``copies[:2]`` to ``copies[2:]``.

    One loop covers the copies, the size classes, the rows of cells and the Gaussians of a row:
    lanes of a packet then wait once for the longest sum.
    """
    sizes, footprint, packed = lookup.sizes, lookup.footprint, lookup.packed
    types = types_of(packed)
    radius = kernel_radius(lookup.cutoff)
    scaled = kernel_covariance(footprint)
    left, top, right, bottom = copies
    bottom = dr.select(active, bottom, top - 1)

    def rows(i: UInt, j: UInt, k: UInt) -> tuple:
        """Return the rows of cells [first, last] of the size class k under the footprint."""
        square, _, _, ny, inverse, origin = _row_of(types, sizes, k)
        _, y0, _ = _local(sizes, i, j, dr.detach(x), dr.detach(y))
        reach = lookup.cutoff * dr.sqrt(footprint[2] + square)
        first = dr.maximum(dr.floor((y0 - reach - origin) * inverse), 0)
        last = dr.minimum(dr.floor((y0 + reach - origin) * inverse), ny - 1)
        return types.Int(first), types.Int(last)

    def run(i: UInt, j: UInt, k: UInt, row: UInt, valid: Bool) -> tuple:
        """Return the range [begin, end) in `splat` of a row of cells in the widened ellipse."""
        square, first, nx, _, inverse, origin = _row_of(types, sizes, k)
        x0, y0, sign = _local(sizes, i, j, dr.detach(x), dr.detach(y))
        xx, xy, yy = footprint[0] + square, footprint[1] * sign, footprint[2] + square
        side = rcp(inverse)
        low = dr.fma(types.Float(row), side, origin) - y0
        reach = lookup.cutoff * dr.sqrt(yy)
        low, high = dr.maximum(low, -reach), dr.minimum(low + side, reach)
        # At height dy the ellipse of footprint + size^2 spans lean * dy - half to lean * dy + half.
        lean, ratio = xy * rcp(yy), rcp(yy)
        free = dr.fma(-xy, lean, xx)
        peak = xy * rsqrt(xx) * lookup.cutoff  # dy of the rightmost point

        def half(dy: Float) -> Any:
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
        n: Any,
        end: Any,
        row: UInt,
        stop: Any,
        k: UInt,
        i: UInt,
        j: UInt,
        x: Float,
        y: Float,
        sums: list,
    ) -> tuple:
        here = (n < end) & (j <= bottom)
        index = gather_index(types, sizes.splat, n, here)
        splat = unpack_parameters(packed, index, lookup.number, here)
        px, py, sign = _local(sizes, i, j, x, y)
        seen = [scaled[0], scaled[1] * sign, scaled[2]]
        shape, amplitude = widen(splat[:NUM_SHAPE_PARAMS], seen)
        (w,) = weights(shape, px, py, (1, 1), radius)
        part = inside_share(shape, seen, px, py, sizes.width, sizes.height)
        w = dr.select(here, w * amplitude * part, 0)
        sums = [dr.fma(w, c, s) for c, s in zip(splat[NUM_SHAPE_PARAMS:], sums, strict=True)]
        n = n + 1
        ran = n >= end
        row = dr.select(ran, row + 1, row)
        fresh = ran & (row > stop)
        k, i, j = _advance(fresh, k, i, j, sizes.count, left, right)
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
    sums = [types.Float(0) for _ in range(lookup.number - NUM_SHAPE_PARAMS)]
    return dr.while_loop(
        (begin, end, row, stop, k, left, top, x, y, sums),
        lambda n, end, row, stop, k, i, j, *rest: j <= bottom,
        add,
        label="sum footprints",
        mode="symbolic",
        max_iterations=-1,
    )[-1]


def _advance(go: Any, k: UInt, i: UInt, j: UInt, sizes: int, left: Any, right: Any) -> tuple:
    """Step to the next size class; after the last class to the next copy or row of copies."""
    k = dr.select(go, k + 1, k)
    over = k >= sizes
    k, i = dr.select(over, 0, k), dr.select(over, i + 1, i)
    over = i > right
    return k, dr.select(over, left, i), dr.select(over, j + 1, j)


def _row_of(types: Any, sizes: SizeClasses, k: UInt) -> list:
    """Gather row k of `SizeClasses.table`."""
    row = gather_run(types, sizes.table, types.UInt(k), 8, True)  # packets need a power of two
    return row[:6]

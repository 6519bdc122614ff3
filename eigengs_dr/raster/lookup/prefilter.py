"""The sum of Gaussians filtered by a Gaussian footprint, in closed form.

The convolution of two Gaussians is a Gaussian. Therefore a pixel sees the sum of widened Gaussians
(`eigengs_dr.raster.evaluate.widen`) and needs neither a mip map nor more samples. At the borders of
the image, a Gaussian is multiplied by the part of its product with the footprint that lies in the
image, and the sum includes all copies of the image that the footprint reaches.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr

from ...backend.arrays import rcp, rsqrt, types_of
from ...backend.types import Bool, Float, UInt
from ..evaluate import weights, widen
from ..parameters import gather_index, kernel_covariance, unpack_parameters
from .footprint import filtered_terms, inside_share
from .points import Packed, cell_range, sum_range
from .size_classes import FOOTPRINT_REACH, SizeClasses


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
        Its copies in the order of lists are from `eigengs_dr.raster.lookup.footprint.arrange`.
    x, y : Float
        Centre of the footprint in pixels, moved into the image by
        `eigengs_dr.raster.lookup.points.fold`.
    footprint : list of 3 Float
        xx, xy, yy of the covariance, in pixels squared; not differentiated.
    active : Bool

    Returns
    -------
    list of Float
        One sum for each channel.
    """
    types = types_of(packed.values)
    footprint = [dr.detach(f) for f in footprint]
    reach = [FOOTPRINT_REACH * dr.safe_sqrt(footprint[k]) for k in (0, 2)]
    widest = dr.maximum(*reach) * (1 / FOOTPRINT_REACH)
    listed = active & (widest <= sizes.listed[-1][0])
    bounds = []
    for v, r, side in zip((x, y), reach, (sizes.width, sizes.height), strict=True):
        listed &= (v >= r) & (v + r <= side)
        bounds.append([types.Int(dr.floor((dr.detach(v) + k) * (1 / side))) for k in (-r, r)])
    ends = _shortest_list(sizes, x, y, widest, listed)
    terms = filtered_terms(packed, footprint)
    total = sum_range(sizes.listed[0][1].splat, ends, packed, x, y, terms)
    rest = active & ~listed
    part = where_any(
        rest, lambda: _sum_copies(sizes, packed, x, y, footprint, bounds, rest), packed
    )
    return [t + p for t, p in zip(total, part, strict=True)]


def _shortest_list(
    sizes: SizeClasses, x: Float, y: Float, widest: Float, active: Bool
) -> tuple[UInt, UInt]:
    """Return begin and end of the shortest list that serves a footprint."""
    types = types_of(x)
    begin, end = types.UInt(0), types.UInt(0)
    for spread, cells in sizes.listed:
        small = active & (widest <= spread)
        found = cell_range(cells, x, y, small)
        begin, end = dr.select(small, found[0], begin), dr.select(small, found[1], end)
        active = active & ~small
    return begin, end


def where_any(
    active: Bool, compute: Callable[[], list], packed: Packed, others: list | None = None
) -> list:
    """Return values that few points need, and skip the work for packets of lanes without one.

    Parameters
    ----------
    active : Bool
        The points that need the values.
    compute : callable
        Returns the values, by default one for each channel.
    packed : Packed
        Parameters. With gradients nothing is skipped: Dr.Jit cannot carry them out of the branch.
    others : list of Float, optional
        The values of other points, by default 0.
    """
    if dr.grad_enabled(packed.values):
        return compute()
    rest = others or [types_of(packed.values).Float(0)] * packed.channels
    return list(
        dr.if_stmt((), active, lambda: tuple(compute()), lambda: tuple(rest), mode="symbolic")
    )


def _local(sizes: SizeClasses, i: UInt, j: UInt, x: Float, y: Float) -> tuple:
    """Return the point in the copy (i, j), and the sign of the footprint's xy in this copy."""
    types = types_of(x)
    x, y = x - types.Float(i) * sizes.width, y - types.Float(j) * sizes.height
    if sizes.wrap == "repeat":
        return x, y, types.Float(1)
    odd_x, odd_y = (i & 1) == 1, (j & 1) == 1
    x, y = dr.select(odd_x, sizes.width - x, x), dr.select(odd_y, sizes.height - y, y)
    return x, y, dr.select(odd_x == odd_y, types.Float(1), -1)


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
    scaled = kernel_covariance(footprint)
    (left, right), (top, bottom) = bounds
    crosses = (left < right) | (top < bottom)
    bottom = dr.select(active, bottom, top - 1)
    classes = dr.width(sizes.table) // 8

    def next_run(fresh: Bool, row: UInt, stop: UInt, place: tuple, valid: Bool) -> tuple:
        """Return the range [begin, end) in `splat` of a row of cells, the row and the last one.

        Where `fresh`, the row is the first one of the size class under the footprint.
        """
        k, i, j = place
        square, cells, nx, ny, inverse, origin = unpack_parameters(sizes.table, types.UInt(k), 6)
        x0, y0, sign = _local(sizes, i, j, dr.detach(x), dr.detach(y))
        xx, xy, yy = footprint[0] + square, footprint[1] * sign, footprint[2] + square
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
        n: UInt, end: UInt, row: UInt, stop: UInt, place: tuple, point: tuple, sums: list
    ) -> tuple:
        (_, i, j), (x, y) = place, point
        here = (n < end) & (j <= bottom)
        shape, color = packed.gather(gather_index(types, sizes.splat, n, here), here)
        px, py, sign = _local(sizes, i, j, x, y)
        seen = [scaled[0], scaled[1] * sign, scaled[2]]
        shape, amplitude = widen(shape, seen)
        (w,) = weights(shape, px, py, (1, 1), packed.radius)
        (part,) = where_any(
            crosses,
            lambda: [inside_share(shape, seen, px, py, sizes.width, sizes.height)],
            packed,
            [types.Float(1)],
        )
        w = dr.select(here, w * amplitude * part, 0)
        sums = [dr.fma(w, c, s) for c, s in zip(color, sums, strict=True)]
        n = n + 1
        state = n, end, row, stop, place
        state = dr.if_stmt(state, n >= end, advance, lambda *same: same, mode="symbolic")
        return *state, point, sums

    zero = dr.zeros(types.Int, dr.width(x))
    start = next_run(types.Bool(True), zero, zero, (zero, left, top), active)
    sums = [types.Float(0) for _ in range(packed.channels)]
    return dr.while_loop(
        (*start, (zero, left, top), (x, y), sums),
        lambda n, end, row, stop, place, *rest: place[2] <= bottom,
        add,
        label="sum footprints",
        mode="symbolic",
        max_iterations=-1,
    )[-1]

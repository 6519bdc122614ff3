"""Which splats touch which tiles of the image.

A tile is the block of pixels that one lane of the renderer owns. The cutoff ellipse of a splat is
tested against the pixel centres of every row of tiles in closed form, so that a stretched splat
visits the tiles along its axis and not those of its bounding box.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ..backend.arrays import ArrayTypes, types_of, upload

TILE = (4, 4)
"""Width and height of a tile in pixels. Measured on 2 cores with AVX-512: 4x4 holds the sums of 16
pixels in registers and visits 1.7 pixels for one inside the ellipse (8x8: 3.3)."""


MAX_LIST_ENTRIES = 1 << 28
"""Longest lists, all tiles together: sorting them takes 4 GiB."""


@dataclass(frozen=True)
class Grid:
    """A `width` x `height` image cut into `nx` x `ny` tiles of `tile` pixels; the last overhang."""

    width: int
    height: int
    tile: tuple[int, int] = TILE

    @property
    def nx(self) -> int:
        """Tiles in a row."""
        return -(-self.width // self.tile[0])

    @property
    def ny(self) -> int:
        """Rows of tiles."""
        return -(-self.height // self.tile[1])

    @property
    def tiles(self) -> int:
        """All tiles."""
        return self.nx * self.ny

    @property
    def pixels(self) -> int:
        """Pixels of one tile."""
        return self.tile[0] * self.tile[1]


@dataclass(frozen=True)
class TileLists:
    """For every tile the splats that may touch it, in ascending order.

    Attributes
    ----------
    grid : Grid
    splat : UInt32, shape (entries,)
        Indices of splats, tile after tile; what follows the last list is not used.
    begin, end : UInt32, shape (tiles,)
        Where the list of the tile `order[i]` lies in `splat`.
    order : UInt32, shape (tiles,)
        Tiles by descending length of their lists: lanes of one SIMD packet then run equally long.
    splat_order : UInt32, shape (N,)
        Splats by descending number of their tiles, for the same reason.
    """

    grid: Grid
    splat: Any
    begin: Any
    end: Any
    order: Any
    splat_order: Any


def tile_columns(
    shape: list, radius: Any, grid: Grid, row: Any, pad: float = 0.0
) -> tuple[Any, Any]:
    """Columns of tiles `[first, last)` that the ellipse of a splat touches in one row of tiles.

    The ellipse is ``(a dx + b dy)^2 + (c dy)^2 <= radius^2``. At height dy its right edge is
    ``(-b dy + sqrt(radius^2 - c^2 dy^2)) / a``, concave in dy with its maximum at
    ``dy* = -b radius / (c sqrt(b^2 + c^2))``; the left edge is its mirror image with the minimum at
    ``-dy*``. Clamping both to the row gives the exact extent over the row.

    Parameters
    ----------
    shape : list of 5 Float
        Mean x, mean y, a, b, c in pixels and 1 / pixels, a > 0 and c > 0.
    radius : float
        Cutoff in the units of the factor.
    grid : Grid
    row : Int32
        Row of tiles.
    pad : float, optional
        Pixels added on every side.

    Returns
    -------
    first, last : Int32
        Clamped to the grid; ``first >= last`` where the row is not touched.
    """
    mx, my, a, b, c = shape
    width, height = grid.tile
    top = type(mx)(row * height) + 0.5 - my
    reach = radius * dr.rcp(c) + pad
    low = dr.maximum(top - pad, -reach)
    high = dr.minimum(top + (height - 1) + pad, reach)
    larger = dr.rcp(dr.maximum(dr.abs(b), c))  # b^2 + c^2 may leave the range of floats
    b1, c1 = b * larger, c * larger
    peak = -radius * b1 * dr.rsqrt(dr.fma(b1, b1, c1 * c1)) * dr.rcp(c)

    def half_width(dy: Any) -> Any:
        return dr.safe_sqrt(radius * radius - dr.square(c * dy))

    inverse = dr.rcp(a)
    right = dr.clip(peak, low, high)
    left = dr.clip(-peak, low, high)
    x_right = mx + (half_width(right) - b * right) * inverse + pad
    x_left = mx - (half_width(left) + b * left) * inverse - pad
    first = dr.clip(dr.ceil((x_left + 0.5) * (1 / width)) - 1, 0.0, float(grid.nx))
    last = dr.clip(dr.floor((x_right - 0.5) * (1 / width)) + 1, 0.0, float(grid.nx))
    hit = (low <= high) & (x_left <= x_right)  # false for NaN as well
    Int = type(row)
    return dr.select(hit, Int(first), 0), dr.select(hit, Int(last), 0)


def tile_rows(shape: list, radius: Any, grid: Grid, pad: float = 0.0) -> tuple[Any, Any]:
    """Rows of tiles `[first, last)` that the ellipse of a splat may touch; see `tile_columns`."""
    Int = types_of(shape[0]).Int
    my, c = shape[1], shape[4]
    height = grid.tile[1]
    reach = radius * dr.rcp(c) + pad
    first = dr.clip(dr.ceil((my - reach + 0.5) * (1 / height)) - 1, 0.0, float(grid.ny))
    last = dr.clip(dr.floor((my + reach - 0.5) * (1 / height)) + 1, 0.0, float(grid.ny))
    finite = dr.isfinite(sum(shape))
    return dr.select(finite, Int(first), 0), dr.select(finite, Int(last), 0)


def for_each_tile(
    shape: list,
    radius: float,
    grid: Grid,
    visit: Callable[..., Any],
    state: Any,
    *,
    pad: float = 0.0,
    label: str,
) -> Any:
    """Let every splat visit the tiles that its cutoff ellipse touches, row by row.

    The two loops over rows and columns are run as one, so that lanes of a packet wait for the
    longest walk in total and not for the longest row each time.

    Parameters
    ----------
    shape : list of 5 Float, shape (N,)
        As in `tile_columns`.
    radius, grid, pad
        As in `tile_columns`.
    visit : callable
        ``visit(tile, column, row, active, state) -> state``, tile being ``row * nx + column``.
    state : PyTree
        Whatever `visit` accumulates.
    label : str
        Name of the loop for profilers.

    Returns
    -------
    PyTree
        The final `state`.
    """
    row, stop = tile_rows(shape, radius, grid, pad)
    column, last = tile_columns(shape, radius, grid, row, pad)

    def body(row: Any, column: Any, last: Any, state: Any) -> tuple:
        state = visit(row * grid.nx + column, column, row, column < last, state)
        column = column + 1
        done = column >= last
        row = dr.select(done, row + 1, row)
        next_column, next_last = tile_columns(shape, radius, grid, row, pad)
        column = dr.select(done, next_column, column)
        return row, column, dr.select(done, next_last, last), state

    return dr.while_loop(
        (row, column, last, state),
        lambda row, *rest: row < stop,
        body,
        label=label,
        max_iterations=-1,
    )[-1]


def build_lists(shape: list, radius: float, grid: Grid, pad: float = 0.0) -> TileLists:
    """List for every tile the splats whose cutoff ellipse touches it.

    Every splat counts its tiles, then writes one key ``tile * N + splat`` for each; sorting the
    keys gives the lists. The order is a function of the input alone, so renderings are bit-equal.
    Cost: O(entries log entries); the splats are walked twice.

    Parameters
    ----------
    shape : list of 5 Float, shape (N,)
        Mean x, mean y and the factor a, b, c, as in `tile_columns`.
    radius : float
        Cutoff in the units of the factor.
    grid : Grid
    pad : float, optional
        Pixels by which the ellipses are enlarged, so that lists stay valid while splats move.

    Raises
    ------
    ValueError
        If the lists would have `MAX_LIST_ENTRIES` entries or more.
    """
    types = types_of(shape[0])
    count = dr.width(shape[0])
    touched = for_each_tile(
        shape,
        radius,
        grid,
        lambda tile, column, row, active, n: n + dr.select(active, types.UInt(1), 0),
        types.UInt(0),
        pad=pad,
        label="count tiles",
    )
    dr.eval(touched)
    entries = int(dr.sum(dr.uint64_array_t(types.UInt)(touched))[0])
    if entries >= MAX_LIST_ENTRIES:
        raise ValueError(
            f"{count} splats touch {entries} tiles in all, {MAX_LIST_ENTRIES} can be listed: "
            "use fewer or smaller splats, or a smaller image"
        )
    Key = types.UInt if grid.tiles * count < 2**32 else dr.uint64_array_t(types.UInt)
    keys = dr.empty(Key, max(entries, 1))
    owner = dr.arange(types.UInt, count)

    def emit(tile: Any, column: Any, row: Any, active: Any, slot: Any) -> Any:
        dr.scatter(keys, Key(tile) * count + Key(owner), slot, active)
        return slot + dr.select(active, types.UInt(1), 0)

    if entries:
        slot = dr.prefix_sum(touched)
        dr.eval(for_each_tile(shape, radius, grid, emit, slot, pad=pad, label="list tiles"), keys)
        keys = _sort(keys)
    return _lists(types, grid, count, keys, entries, touched)


def _lists(
    types: ArrayTypes, grid: Grid, count: int, keys: Any, entries: int, touched: Any
) -> TileLists:
    """Turn sorted keys ``tile * N + splat`` into lists."""
    Key = type(keys)
    # A power of two: numbers in programs are constants, and few of them keep what is compiled and
    # what is frozen in use. It is even as well, so that lists can be read in pairs.
    capacity = 2 << entries.bit_length()
    padded = dr.full(Key, (1 << 8 * dr.itemsize_v(Key)) - 1, capacity)
    if entries:
        dr.scatter(padded, keys, dr.arange(types.UInt, entries))
    needle = Key(dr.arange(types.UInt, grid.tiles + 1)) * count
    starts = types.UInt(
        dr.binary_search(0, capacity, lambda i: dr.gather(Key, padded, types.UInt(i)) < needle)
    )
    splat = types.UInt(padded % count)
    dr.eval(starts, splat)
    begin = dr.gather(types.UInt, starts, dr.arange(types.UInt, grid.tiles))
    end = dr.gather(types.UInt, starts, dr.arange(types.UInt, grid.tiles) + 1)
    order = _order_descending(end - begin)
    begin, end = dr.gather(types.UInt, begin, order), dr.gather(types.UInt, end, order)
    lists = TileLists(grid, splat, begin, end, order, _order_descending(touched))
    dr.eval(begin, end, order, lists.splat_order)
    return lists


def _order_descending(length: Any) -> Any:
    """Indices that sort lengths in descending order, ties by index."""
    UInt = type(length)
    count = dr.width(length)
    Key = dr.uint64_array_t(UInt)
    longest = int(dr.max(length)[0])
    Key = UInt if (longest + 1) * count < 2**32 else Key
    shorter = dr.opaque(UInt, longest) - length
    keys = _sort(Key(shorter) * count + Key(dr.arange(UInt, count)))
    return UInt(keys % count)


def _sort(keys: Any) -> Any:
    """Sort integers; NumPy's vectorised sort is 7 times as fast as `drjit.sort` on the CPU."""
    if dr.backend_v(keys) == dr.JitBackend.LLVM:
        return upload(type(keys), np.sort(keys.numpy()))
    return dr.sort(keys)

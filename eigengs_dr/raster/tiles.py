"""Lists of the Gaussians that touch each tile of the image.

A tile is the block of pixels that one lane of the renderer owns. A closed form gives the tiles of
each row that the cutoff ellipse of a Gaussian touches. An elongated Gaussian therefore visits only
the tiles along its axis, not all tiles of its bounding box.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ..backend.arrays import ArrayTypes, types_of, upload

TILE = (4, 4)
"""Width and height of a tile in pixels. Measured on 2 cores with AVX-512: 4x4 keeps the sums of 16
pixels in registers and visits 1.7 pixels for each pixel inside the ellipse (8x8: 3.3)."""

MAX_LIST_ENTRIES = 1 << 28
"""Largest number of entries in the lists of all tiles; sorting them takes 4 GiB."""


@dataclass(frozen=True)
class Grid:
    """Division of a `width` x `height` image into `nx` x `ny` tiles; the last may overhang."""

    width: int
    height: int
    tile: tuple[int, int] = TILE

    @property
    def nx(self) -> int:
        """Number of columns of tiles."""
        return -(-self.width // self.tile[0])

    @property
    def ny(self) -> int:
        """Number of rows of tiles."""
        return -(-self.height // self.tile[1])

    @property
    def tiles(self) -> int:
        """Number of tiles."""
        return self.nx * self.ny

    @property
    def pixels(self) -> int:
        """Number of pixels of one tile."""
        return self.tile[0] * self.tile[1]


@dataclass(frozen=True)
class TileLists:
    """Indices of the Gaussians that may touch each tile, in ascending order.

    Attributes
    ----------
    grid : Grid
    splat : UInt32, shape (capacity,)
        Indices of Gaussians, tile after tile; entries after the last list are not used.
    begin, end : UInt32, shape (tiles,)
        Range in `splat` of the list of the tile ``order[i]``.
    order : UInt32, shape (tiles,)
        Tiles by descending length of their lists: lanes of one SIMD packet then take equally long.
    splat_order : UInt32, shape (N,)
        Gaussians by descending number of their tiles, for the same reason.
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
    """Return the columns `[first, last)` that the ellipse of a Gaussian touches in a row of tiles.

    The ellipse is ``(a dx + b dy)^2 + (c dy)^2 <= radius^2``. At height dy its right edge is
    ``(-b dy + sqrt(radius^2 - c^2 dy^2)) / a``, which is concave in dy with its maximum at
    ``dy* = -b radius / (c sqrt(b^2 + c^2))``. The left edge is the mirror image with its minimum at
    ``-dy*``. Both heights, clamped to the row, give the exact extent in the row.

    Parameters
    ----------
    shape : list of 5 Float
        Mean x, mean y in pixels; a, b, c in 1 / pixels, in the units of `radius`; a > 0, c > 0.
    radius : float
        Cutoff in the units of the factor.
    grid : Grid
    row : Int32
        Row of tiles.
    pad : float, optional
        Pixels by which the ellipse is enlarged on every side.

    Returns
    -------
    first, last : Int32
        Clamped to the grid; ``first >= last`` if the ellipse does not touch the row.
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
    """Return the rows of tiles `[first, last)` that the ellipse may touch; see `tile_columns`."""
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
    """Call `visit` for every Gaussian and every tile that its ellipse touches, row by row.

    One loop covers rows and columns: lanes of a packet then wait once for the longest walk, and not
    in every row for the longest row.

    Parameters
    ----------
    shape : list of 5 Float, shape (N,)
        As for `tile_columns`.
    radius, grid, pad
        As for `tile_columns`.
    visit : callable
        ``visit(tile, column, row, active, state) -> state`` with ``tile = row * nx + column``.
    state : PyTree
        Initial state.
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
    """List for every tile the Gaussians whose cutoff ellipse touches it.

    Every Gaussian counts its tiles, then writes a key ``tile * N + index`` for each tile. The
    sorted keys give the lists. Their order depends only on the input, so renderings are equal bit
    by bit. Cost: O(entries log entries) and two visits of all tiles.

    Parameters
    ----------
    shape, radius, grid
        As for `tile_columns`; arrays of shape (N,).
    pad : float, optional
        Pixels by which the ellipses are enlarged, so that lists stay valid while Gaussians move.

    Returns
    -------
    TileLists

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
            f"{count} Gaussians touch {entries} tiles, the limit is {MAX_LIST_ENTRIES}: "
            "use fewer or smaller Gaussians, or a smaller image"
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
    """Convert sorted keys ``tile * N + index`` to lists."""
    Key = type(keys)
    # Programs contain the capacity as a constant: with powers of two, few programs are compiled and
    # frozen ones can be replayed. The capacity is even, so that lists can be read in pairs.
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
    """Return the indices that sort lengths in descending order, and equal lengths by index."""
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

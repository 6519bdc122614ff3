"""Lists of the Gaussians that touch each tile, and of the tiles that each Gaussian touches.

Both list the same pairs of a Gaussian and a tile: the sum over Gaussians reads them by tile, and
its adjoint by Gaussian. The adjoint therefore is the exact transpose of the sum, even while
Gaussians move between two builds of the lists.

The Gaussians by tile are the transpose of the tiles by Gaussian. On llvm, a counting sort on one
core is 18 times as fast as sorting keys in Dr.Jit (450,000 entries). On cuda, a radix sort needs no
copy to the host. Lanes are ordered so that the lanes of a SIMD packet, and the blocks of all
cores, have similar amounts of work.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..backend.arrays import ArrayTypes, make_divisor, sorting_index, types_of, upload
from ..backend.recording import record
from ..backend.types import Bool, FloatLike, UInt
from .evaluate import is_steep
from .tiles import (
    TILE,
    Grid,
    TileLayout,
    for_each_row,
    granularity_of,
    tile_columns,
    tile_rows,
)

MAX_LIST_ENTRIES = 1 << 28
"""Largest number of entries in the lists of all tiles; they take 4 GiB while they are built."""

TILE_WINDOW = 32
"""Side, in tiles, of the squares within which tiles are sorted by the length of their lists."""

PIECE_WINDOW = 2048
"""Number of consecutive pieces that are sorted by length."""


@dataclass(frozen=True)
class Pieces:
    """The tiles that each Gaussian touches, cut into pieces: the lanes of the adjoint.

    Attributes
    ----------
    tile : UInt32, shape (capacity,)
        Tiles, Gaussian after Gaussian; entries after the last Gaussian are not used.
    splat, begin, end : UInt32, shape (pieces,)
        Gaussian of each piece, and its range in `tile`; empty for the padding at the end.
    slot : UInt32, shape (pieces,)
        Position of the result of a piece: the pieces of one Gaussian are neighbours.
    first, number : UInt32, shape (N,)
        Slots ``[first, first + number)`` of each Gaussian.
    capacity : (int, int)
        Sizes of `tile` and `slot`. When Dr.Jit 1.5 replays a frozen program, it infers the sizes of
        its arrays from those of the arguments, and may write out of bounds if one of them has
        changed. These numbers are part of the arguments, so that other sizes are traced anew.
    """

    tile: UInt
    splat: UInt
    begin: UInt
    end: UInt
    slot: UInt
    first: UInt
    number: UInt
    capacity: tuple[int, int]


@dataclass(frozen=True, repr=False)
class TileLists:
    """Indices of the Gaussians that may touch each tile, in ascending order.

    Attributes
    ----------
    grid : Grid
    layout : TileLayout
        That of `grid`, in arrays.
    splat : UInt32, shape (capacity,)
        Indices of Gaussians, tile after tile; entries after the last list are not used.
    begin, end : UInt32, shape (tiles,)
        Range in `splat` of the list of tile ``order[i]``.
    order : UInt32, shape (tiles,)
        Tiles in the order of lanes: the lists in a SIMD packet have similar lengths.
    image : UInt32, shape (N,), or None
        Image of each Gaussian; None if there is only one image.
    pieces : Pieces or None
        The same pairs by Gaussian, for the adjoint; None if they were not requested.
    capacity : int
        Size of `splat`, for the same reason as in `Pieces`.
    exact_exp : bool or Bool, shape (1,)
        Whether weights need an exponential at every pixel, because a Gaussian is too narrow, a tile
        is not 4 pixels wide, or exponentials are cheaper; see
        `eigengs_dr.raster.evaluate.weights`. With an array, from `update_exact_exp`, the device
        decides.
    radius : float
        Cutoff for which the lists were built, in the units of the factor.
    frame : tuple
        What the rendering shows, if `eigengs_dr.tile_lists` built the lists.
    """

    grid: Grid
    layout: TileLayout
    splat: UInt
    begin: UInt
    end: UInt
    order: UInt
    image: UInt | None
    pieces: Pieces | None
    capacity: int
    exact_exp: bool | Bool
    radius: float
    frame: tuple = ()

    def runs(self, begin: UInt, end: UInt) -> list[tuple[bool, UInt, UInt]]:
        """Return loops over ``[begin, end)``: (exact_exp, begin, end) of each.

        If the device decides, there are two loops, one of which it leaves empty.
        """
        if isinstance(self.exact_exp, bool):
            return [(self.exact_exp, begin, end)]
        return [
            (False, begin, dr.select(self.exact_exp, begin, end)),
            (True, begin, dr.select(self.exact_exp, end, begin)),
        ]

    def __repr__(self) -> str:
        width, height = self.grid.width, self.grid.height
        return f"TileLists({width}x{height} pixels, {self.capacity} entries)"


def build_lists(
    shape: list,
    radius: float,
    grid: Grid,
    pad: FloatLike = 0.0,
    growth: float = 1.0,
    adjoint: bool = True,
    ordered: bool = True,
) -> TileLists:
    """For every tile, list the Gaussians whose cutoff ellipse touches it.

    Every Gaussian counts its tiles, then writes them. The transpose of this list gives the lists of
    the tiles, by a counting sort on llvm and by a radix sort on cuda. Their order depends only on
    the input, so that renderings are bit-identical. Cost: linear in the number of entries, and one
    copy of a few bytes from the device to the host.

    Parameters
    ----------
    shape : list of 5 Float, shape (N,)
        As for `eigengs_dr.raster.tiles.tile_columns`.
    radius : float
        Cutoff in the units of the factor.
    grid : Grid
    pad : float or Float, shape (N,), optional
        Pixels by which an ellipse is enlarged, so that lists stay valid while Gaussians move.
    growth : float, optional
        Factor by which an ellipse is enlarged, so that lists stay valid while Gaussians grow.
    adjoint : bool, optional
        Whether to list the tiles of each Gaussian too.
    ordered : bool, optional
        Whether to order lanes by their work, if the backend benefits from it.

    Returns
    -------
    TileLists

    Raises
    ------
    ValueError
        If the lists would have `MAX_LIST_ENTRIES` entries or more.
    """
    types = types_of(shape[0])
    # Numbers are in arrays: as literals, each value would compile a program of its own.
    layout, wide = grid.in_arrays(types), dr.opaque(types.Float, radius * growth)
    if isinstance(pad, float):  # one for each Gaussian, as from a fit: one program for both
        pad = dr.opaque(types.Float, pad, dr.width(shape[0]))
    share = granularity_of(types)
    touched, totals = _count_tiles(shape, radius, wide, layout, pad)
    narrow, entries = divmod(int(totals[0]), 1 << 40)  # one copy to the host
    exact_exp = narrow > 0 or not share.products or grid.tile[0] != TILE[0]
    if entries >= MAX_LIST_ENTRIES:
        raise ValueError(
            f"{dr.width(touched)} Gaussians touch {entries} tiles, the limit is "
            f"{MAX_LIST_ENTRIES}: use fewer or smaller Gaussians, or a smaller image"
        )
    visits = share.visits_for(entries // grid.images, grid.tiles // grid.images)
    image = _images(types, dr.width(touched), grid)
    # At most one piece of each Gaussian is not full: this bounds their number without a copy.
    max_pieces = _padded(dr.width(touched) + entries // visits) if adjoint else 0
    tile, last, cut = _list_tiles(
        shape, wide, layout, pad, image, touched, visits, (_padded(entries), max_pieces)
    )
    pieces = _in_order(types, tile, *cut) if adjoint else None
    transpose = transpose_by_counting if types.backend == "llvm" else transpose_by_sorting
    splat, starts = transpose(types, grid.tiles, tile, last, entries, dr.width(tile))
    order, begin, end = _lanes(types, grid, starts, ordered and share.ordered)
    lists = TileLists(
        grid, layout, splat, begin, end, order, image, pieces, dr.width(splat), exact_exp, radius
    )
    dr.eval(lists)
    return lists


def update_exact_exp(lists: TileLists, shape: list, radius: float) -> TileLists:
    """Return lists with `TileLists.exact_exp` updated for Gaussians that have changed since.

    Nothing is copied to the host, so that frozen programs can record it. A kernel then contains
    both ways to evaluate weights; the result is bit-identical to that of the chosen one alone.

    Parameters
    ----------
    lists : TileLists
        With pieces.
    shape : list of 5 Float, shape (N,)
        The current Gaussians.
    radius : float
    """
    if lists.exact_exp is True:
        return lists
    assert lists.pieces is not None
    types = types_of(shape[0])
    # All lanes write the same value. Dr.Jit fuses this with the kernel that packs the parameters; a
    # reduction would need two more kernels.
    any_steep = dr.zeros(types.UInt, 1)
    dr.make_opaque(any_steep)
    dr.scatter(any_steep, 1, types.UInt(0), is_steep(shape, radius) & (lists.pieces.number > 0))
    return replace(lists, exact_exp=any_steep != 0)


def _images(types: ArrayTypes, count: int, grid: Grid) -> UInt | None:
    """Return the image of each of `count` Gaussians; None if there is only one image."""
    if grid.images == 1:
        return None
    image, _ = make_divisor(types, count // grid.images).divmod(dr.arange(types.UInt, count))
    dr.schedule(image)
    return image


def _padded(count: int) -> int:
    """Round a size up to a multiple of 16, by at most a quarter and at most 2^20.

    Frozen programs are traced again for each new size, so sizes should change rarely. For long
    lists, a trace costs less than the memory would.
    """
    step = max(16, 1 << max(0, min(count.bit_length() - 3, 20)))
    return (count // step + 1) * step


@record
def _count_tiles(
    shape: list, radius: float, wide: FloatLike, grid: TileLayout, pad: FloatLike
) -> tuple[UInt, UInt]:
    """Return the number of tiles that each Gaussian touches, and a total for one copy to the host.

    The total is the number of all entries, plus 2^40 for each Gaussian that is steep.
    """
    types = types_of(shape[0])
    UInt64 = dr.uint64_array_t(types.UInt)

    def add(row: UInt, first: UInt, last: UInt, total: UInt) -> UInt:
        return total + types.UInt(dr.maximum(last - first, 0))

    touched = for_each_row(shape, wide, grid, add, types.UInt(0), pad=pad, label="count tiles")
    dr.schedule(touched)  # in the kernel of the sum
    steep = is_steep(shape, radius) & (touched > 0)
    return touched, dr.sum(dr.fma(UInt64(dr.select(steep, 1, 0)), 1 << 40, UInt64(touched)))


@record
def _list_tiles(
    shape: list,
    radius: FloatLike,
    grid: TileLayout,
    pad: FloatLike,
    image: UInt | None,
    touched: UInt,
    visits: int,
    capacity: tuple[int, int],
) -> tuple[UInt, UInt, tuple | None]:
    """Return the tiles of all Gaussians, their ends, and the pieces from `_cut`."""
    types = types_of(shape[0])
    UInt64 = dr.uint64_array_t(types.UInt)
    number = (touched + (visits - 1)) // visits
    # One prefix sum for the tiles and the pieces: each sum fits into 32 bits.
    both = dr.fma(UInt64(number), 1 << 32, UInt64(touched))
    dr.schedule(number)
    before = dr.prefix_sum(both)
    start, first = types.UInt(before), types.UInt(before >> 32)
    last = start + touched
    dr.schedule(first, last)
    by_entry = granularity_of(types).block > 0
    emit, cut = (_find_tiles, _find_cut) if by_entry else (_emit_tiles, _cut)
    tile = emit(types, shape, radius, grid, pad, image, (start, last), capacity[0])
    dr.schedule(tile)
    pieces = cut(types, (start, last), (first, number), capacity[1]) if capacity[1] else None
    return tile, last, pieces


def _emit_tiles(
    types: ArrayTypes,
    shape: list,
    radius: FloatLike,
    grid: TileLayout,
    pad: FloatLike,
    image: UInt | None,
    slots: tuple[UInt, UInt],
    capacity: int,
) -> UInt:
    """Write the tiles of each Gaussian to its slots ``[start, last)``."""
    start, last = slots
    # Zeros, because rounding may make the two traversals differ by a tile in different programs.
    tiles = dr.zeros(types.UInt, capacity)
    dr.make_opaque(tiles)
    first = types.UInt(0) if grid.image is None or image is None else image * grid.image.divisor

    # In every row, the lanes of a packet wait for the longest row. One loop over rows and columns
    # would avoid the wait, but compute the columns of a row for every tile: on llvm it took three
    # times as long.
    def emit_row(row: UInt, left: UInt, right: UInt, slot: UInt) -> UInt:
        def emit(column: UInt, slot: UInt) -> tuple[UInt, UInt]:
            tile, active = types.UInt(row * grid.nx + column) + first, column < right
            dr.scatter(tiles, tile, slot, active & (slot < last))
            return column + 1, slot + dr.select(active, types.UInt(1), 0)

        return dr.while_loop(
            (left, slot),
            lambda column, slot: column < right,
            emit,
            label="list tiles",
            max_iterations=-1,
        )[-1]

    slot = for_each_row(shape, radius, grid, emit_row, start, pad=pad, label="list tiles")
    dr.schedule(slot, tiles)
    return tiles


def _find_tiles(
    types: ArrayTypes,
    shape: list,
    radius: FloatLike,
    grid: TileLayout,
    pad: FloatLike,
    image: UInt | None,
    slots: tuple[UInt, UInt],
    capacity: int,
) -> UInt:
    """Return the tiles of `_emit_tiles`, with one lane per entry that searches its Gaussian's rows.

    With one lane per Gaussian, and one that adds all of its pieces, a GPU waits for the largest
    Gaussian: a fit of 2048x2048 pixels and 320,000 Gaussians took 5.7 s instead of 1.1 s (H200).
    """
    start, last = slots
    i, count = dr.arange(types.UInt, capacity), dr.opaque(types.UInt, dr.width(last))
    dr.eval(start, last)
    owner = _search(count, last, i + 1)
    real = owner < count
    owner_shape = [dr.gather(types.Float, row, owner, real) for row in shape]
    pad = dr.gather(types.Float, pad, owner, real)
    row, stop = tile_rows(owner_shape, radius, grid, pad)

    def visit(row: UInt, left: UInt, tile: UInt) -> tuple:
        first, last = tile_columns(owner_shape, radius, grid, row, pad)
        inside = dr.maximum(last - first, 0)
        here = left < inside
        tile = dr.select(here, row * grid.nx + first + left, tile)
        return dr.select(here, stop, row + 1), left - inside, tile

    left = types.Int(i - dr.gather(types.UInt, start, owner, real))
    tile = dr.while_loop(
        (dr.select(real, row, stop), left, types.Int(-1)),
        lambda row, left, tile: row < stop,
        visit,
        label="find tiles",
        max_iterations=-1,
    )[-1]
    # Rounding may make the two traversals differ by a tile in different programs.
    first = types.UInt(0)
    if grid.image is not None and image is not None:
        first = dr.gather(types.UInt, image, owner, real) * grid.image.divisor
    return dr.select(tile < 0, types.UInt(0), types.UInt(tile) + first)


def _lanes(types: ArrayTypes, grid: Grid, starts: UInt, ordered: bool) -> tuple[UInt, UInt, UInt]:
    """Return the order of the tiles, and the ranges of their lists in this order."""
    tile = dr.arange(types.UInt, grid.tiles)
    if ordered:
        ends = starts.numpy().view(np.int32)
        length = ends[1:] - ends[:-1]
        x, y = (np.arange(n, dtype=np.int32) // TILE_WINDOW for n in (grid.nx, grid.ny))
        window = (x + y[:, None] * (x[-1] + 1)).ravel()
        images = np.arange(grid.images, dtype=np.int32)[:, None]
        window = (window + (window[-1] + 1) * images).ravel()
        tile = upload(types.UInt, order_lanes(length, window))
    return tile, dr.gather(types.UInt, starts, tile), dr.gather(types.UInt, starts, tile + 1)


def _cut(types: ArrayTypes, tiles: tuple, slots: tuple, capacity: int) -> tuple:
    """Cut the tiles of every Gaussian into pieces of similar length, at most the granularity.

    Parameters
    ----------
    tiles : tuple of UInt32, shape (N,)
        Start and end of the tiles of each Gaussian.
    slots : tuple of UInt32, shape (N,)
        First piece and number of pieces of each Gaussian.
    capacity : int
        Number of pieces, with padding.

    Returns
    -------
    splat, begin, end, first, number
        See `Pieces`.
    """
    (start, last), (first, number) = tiles, slots
    count, stop = dr.width(number), first + number
    splat, begin, end = (dr.zeros(types.UInt, capacity) for _ in range(3))
    dr.make_opaque(splat, begin, end)
    owner = dr.arange(types.UInt, count)
    # In integers: on cuda, a quotient of floats may be rounded up by one.
    length = (last - start + number - 1) // dr.maximum(number, 1)

    def write(i: UInt, at: UInt) -> tuple:
        active = i < stop
        dr.scatter(splat, owner, i, active)
        dr.scatter(begin, at, i, active)
        dr.scatter(end, dr.minimum(at + length, last), i, active)
        return i + 1, at + length

    done = dr.while_loop((first, start), lambda i, at: i < stop, write, label="cut pieces")
    dr.eval(done, splat, begin, end)
    return splat, begin, end, first, number


def _find_cut(types: ArrayTypes, tiles: tuple, slots: tuple, capacity: int) -> tuple:
    """Return the pieces of `_cut`, with one lane per piece."""
    (start, last), (first, number) = tiles, slots
    i, count = dr.arange(types.UInt, capacity), dr.opaque(types.UInt, dr.width(number))
    stop = first + number
    length = (last - start + number - 1) // dr.maximum(number, 1)
    dr.eval(stop, length, first)
    owner = _search(count, stop, i + 1)
    real = owner < count
    at, size, end, before = (
        dr.gather(types.UInt, v, owner, real) for v in (start, length, last, first)
    )
    begin = dr.fma(i - before, size, at)
    splat = dr.select(real, owner, 0)
    begin, end = dr.select(real, begin, 0), dr.select(real, dr.minimum(begin + size, end), 0)
    dr.eval(splat, begin, end)
    return splat, begin, end, first, number


def _in_order(
    types: ArrayTypes, tile: UInt, splat: UInt, begin: UInt, end: UInt, first: UInt, number: UInt
) -> Pieces:
    """Return pieces in the order of lanes."""
    capacity = dr.width(splat)
    slot = dr.arange(types.UInt, capacity)
    if granularity_of(types).ordered:
        lengths = (end - begin).numpy().view(np.int32)
        window = np.arange(capacity, dtype=np.int32) // PIECE_WINDOW
        slot = upload(types.UInt, order_lanes(lengths, window))
        splat, begin, end = (dr.gather(types.UInt, v, slot) for v in (splat, begin, end))
    return Pieces(tile, splat, begin, end, slot, first, number, (dr.width(tile), capacity))


RADIX_BITS = 8
"""Largest number of bits of one pass of the radix sort. On cuda, a pass of Dr.Jit is stable up to
9 bits, as long as its counts fit into shared memory."""


def transpose_by_counting(
    types: ArrayTypes, number: int, tile: UInt, last: UInt, entries: int, capacity: int
) -> tuple[UInt, UInt]:
    """Transpose by SciPy's counting sort: one pass over the entries, on the host.

    Parameters
    ----------
    types : ArrayTypes
    number : int
        Number of tiles.
    tile : UInt32
        Tiles, Gaussian after Gaussian; only the first `entries` are used.
    last : UInt32, shape (N,)
        End of the tiles of each Gaussian.
    entries : int
        Number of pairs of a Gaussian and a tile.
    capacity : int
        Size of the result, at least `entries`.

    Returns
    -------
    splat : UInt32, shape (capacity,)
        Gaussians, tile after tile, and padding in [0, N).
    starts : UInt32, shape (number + 1,)
        Range ``[starts[t], starts[t + 1])`` of tile t in `splat`.
    """
    starts = np.concatenate([[0], last.numpy()]).astype(np.int32)
    columns = tile.numpy()[:entries].view(np.int32)
    # The values are not used: memory that is never written takes no space.
    pattern = csr_array((np.empty(entries, np.int8), columns, starts), (len(last), number))
    by_tile = pattern.tocsc()  # its indices ascend
    splat = dr.empty(types.UInt, capacity)
    dr.eval(splat)
    memory = splat.numpy()  # on llvm a view: no second copy of the largest array
    memory[:entries], memory[entries:] = by_tile.indices, 0
    return splat, upload(types.UInt, by_tile.indptr.view(np.uint32))


def transpose_by_sorting(
    types: ArrayTypes, number: int, tile: UInt, last: UInt, entries: int, capacity: int
) -> tuple[UInt, UInt]:
    """Transpose by a stable radix sort, on the device, of the bits that tile indices need.

    The entries are in the order of the Gaussians, and a stable sort by tile preserves it. Nothing
    is copied to the host, and numbers are in arrays: as literals, every size would compile programs
    of its own. Parameters and results as for `transpose_by_counting`.
    """
    UInt, bits = types.UInt, (number - 1).bit_length()
    i, real = dr.arange(UInt, capacity), dr.opaque(UInt, entries)
    # Padding gets the largest key, so that it stays behind the entries.
    key = dr.select(i < real, dr.gather(UInt, tile, i), (1 << bits) - 1)
    owner = _search(dr.opaque(UInt, dr.width(last)), last, i + 1)
    key, splat = _sort_stably(key, dr.select(i < real, owner, 0), bits)
    return splat, _search(real, key, dr.arange(UInt, number + 1))


def _sort_stably(key: UInt, value: UInt, bits: int) -> tuple[UInt, UInt]:
    """Sort keys of `bits` bits, and values by their keys, from the lowest digit to the highest.

    `drjit.sort` always sorts all 32 or 64 bits.
    """
    UInt = type(key)
    passes = -(-bits // RADIX_BITS)
    width = -(-bits // max(1, passes))
    for k in range(passes):
        digit = (key >> (k * width)) & ((1 << width) - 1)
        dr.eval(digit, key, value)
        order = sorting_index(digit, 1 << width)
        key, value = dr.gather(UInt, key, order), dr.gather(UInt, value, order)
    dr.eval(key, value)
    return key, value


def _search(size: UInt, values: UInt, bound: UInt) -> UInt:
    """Return how many of the first `size` values, in ascending order, are below each bound.

    The number of steps depends only on the bit length of the width, rounded up, so that few
    programs serve all sizes; `drjit.binary_search` has the size in its program.
    """
    UInt, count = type(values), dr.zeros(type(values), dr.width(bound))
    for bit in reversed(range(-(-dr.width(values).bit_length() // 4) * 4)):
        index = count + (1 << bit)
        valid = index <= size
        below = dr.gather(UInt, values, index - 1, valid) < bound
        count = dr.select(valid & below, index, count)
    return count


PACKET = 16
"""Number of lanes of a SIMD packet, as in AVX-512."""


def order_lanes(length: NDArray[np.int32], window: NDArray[np.int32]) -> NDArray[np.uint32]:
    """Return an order of lanes: similar lengths in a packet, empty packets spread evenly.

    On llvm, Dr.Jit cuts a launch into blocks of neighbouring lanes, two for each core. A tenth to a
    third of the lanes of the pieces are empty, all at the end: the last block would have no work.
    In a simulation, the longest thread had 1.27 times the mean work on 2 cores, 1.46 times on 16
    and 1.51 times on 64; with an even spread 1.01, 1.10 and 1.15 times (512x512, 20,000
    Gaussians).

    Parameters
    ----------
    length : ndarray of int32, shape (lanes,)
        Work of each lane.
    window : ndarray of int32, shape (lanes,)
        Index of the window of each lane; a lane stays in its window, near its spatial neighbours.

    Returns
    -------
    ndarray of uint32, shape (lanes,)
        By window, then by descending length; packets without work are spread among the others.
    """
    # NumPy sorts 16 bits fastest; a longer list than that is like the longest.
    falling = 65535 - np.minimum(length, 65535).astype(np.uint16)
    order = np.lexsort((falling, window.astype(np.uint16))).astype(np.uint32)
    in_packets = len(order) // PACKET * PACKET
    packets = order[:in_packets].reshape(-1, PACKET)
    full = (length[packets[:, 0]] > 0) | (length[packets[:, -1]] > 0)
    place = np.empty(len(packets), np.uint16)
    for kind in (full, ~full):
        place[kind] = np.linspace(0, 65535, kind.sum())
    packets = packets[np.argsort(place, kind="stable")]
    return np.concatenate([packets.ravel(), order[in_packets:]])

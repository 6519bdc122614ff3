"""Lists of the Gaussians that touch each tile, and of the tiles that each Gaussian touches.

Both list the same pairs of a Gaussian and a tile: the sum over Gaussians reads them by tile, and
its adjoint reads them by Gaussian. The adjoint therefore is the exact transpose of the sum, also
while Gaussians move between two builds of the lists.

The Gaussians by tile are the transpose of the tiles by Gaussian. On llvm a counting sort on one
core is 18 times as fast as a sort of keys in Dr.Jit (450,000 entries). On cuda a radix sort needs
no copy to the host. Lanes are ordered for SIMD packets of like work, and for blocks of like work
for every core.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array

from ...backend.arrays import ArrayTypes, make_divisor, types_of, upload
from ...backend.detail import sorting_index
from ...backend.recording import record
from ...backend.types import Bool, FloatLike, UInt
from ..evaluate import is_steep
from .tiles import (
    TILE,
    Grid,
    GridArrays,
    for_each_row,
    for_each_tile,
    granularity_of,
    tile_columns,
    tile_rows,
)

MAX_LIST_ENTRIES = 1 << 28
"""Largest number of entries in the lists of all tiles; they take 4 GiB while they are built."""

TILE_WINDOW = 32
"""Side in tiles of the squares within which tiles are ordered by the length of their lists."""

PIECE_WINDOW = 2048
"""Pieces among which the pieces are ordered by their length."""


@dataclass(frozen=True)
class Pieces:
    """The tiles that each Gaussian touches, in pieces of few visits: the lanes of the adjoint.

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
        Sizes of `tile` and `slot`. A replay of a frozen program of Dr.Jit 1.5 infers the sizes of
        its arrays from those of its arguments, and may write outside of memory if one changes. The
        numbers are part of the arguments, so that other sizes are traced anew.
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
    sizes : GridArrays
        Those of `grid`.
    splat : UInt32, shape (capacity,)
        Indices of Gaussians, tile after tile; entries after the last list are not used.
    begin, end : UInt32, shape (tiles,)
        Range in `splat` of the list of the tile ``order[i]``.
    order : UInt32, shape (tiles,)
        Tiles in the order of lanes: neighbours in one SIMD packet have lists of like length.
    image : UInt32, shape (N,), or None
        Image of each Gaussian; None if there is only one image.
    pieces : Pieces or None
        The same pairs by Gaussian, for the adjoint; None if they were not asked for.
    capacity : int
        Size of `splat`, for the same reason as in `Pieces`.
    steep : bool or Bool, shape (1,)
        Whether weights take exponentials at every pixel, because a Gaussian is too narrow, a tile
        is not 4 pixels wide or exponentials cost less; see `eigengs_dr.raster.evaluate.weights`.
        An array, from `steep_now`, decides on the device.
    radius : float
        Cutoff for which the lists were made, in the units of the factor.
    """

    grid: Grid
    sizes: GridArrays
    splat: UInt
    begin: UInt
    end: UInt
    order: UInt
    image: UInt | None
    pieces: Pieces | None
    capacity: int
    steep: bool | Bool
    radius: float

    def runs(self, begin: UInt, end: UInt) -> list[tuple[bool, UInt, UInt]]:
        """Return loops over ``[begin, end)``: whether each takes exponentials, its begin and end.

        Where the device decides, there are two, of which it leaves one empty.
        """
        if isinstance(self.steep, bool):
            return [(self.steep, begin, end)]
        return [
            (False, begin, dr.select(self.steep, begin, end)),
            (True, begin, dr.select(self.steep, end, begin)),
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
    """List for every tile the Gaussians whose cutoff ellipse touches it.

    Every Gaussian counts its tiles, then writes its tiles. The transpose of this list gives the
    lists of the tiles, by a counting sort on llvm and by a radix sort on cuda. Their order depends
    only on the input, so renderings are equal bit by bit. Cost: linear in the number of entries,
    and one copy of a few bytes from the device to the host.

    Parameters
    ----------
    shape : list of 5 Float, shape (N,)
        As for `eigengs_dr.raster.binning.tiles.tile_columns`.
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
        Whether lanes are to be ordered by their work, where the backend gains from it.

    Returns
    -------
    TileLists

    Raises
    ------
    ValueError
        If the lists would have `MAX_LIST_ENTRIES` entries or more.
    """
    types = types_of(shape[0])
    # Numbers in arrays: as literals, they would compile the programs again and again.
    sizes, wide = grid.in_arrays(types), dr.opaque(types.Float, radius * growth)
    pad = dr.opaque(types.Float, pad) if isinstance(pad, float) else pad
    share = granularity_of(types)
    touched, totals = _count_tiles(shape, radius, wide, sizes, pad)
    narrow, entries = divmod(int(totals[0]), 1 << 40)  # one copy to the host
    steep = narrow > 0 or not share.products or grid.tile[0] != TILE[0]
    if entries >= MAX_LIST_ENTRIES:
        raise ValueError(
            f"{dr.width(touched)} Gaussians touch {entries} tiles, the limit is "
            f"{MAX_LIST_ENTRIES}: use fewer or smaller Gaussians, or a smaller image"
        )
    visits = share.visits_for(entries // grid.images, grid.tiles // grid.images)
    image = _images(types, dr.width(touched), grid)
    # At most one piece of a Gaussian is not full, which bounds their number without reading it.
    most = _padded(dr.width(touched) + entries // visits) if adjoint else 0
    tile, last, cut = _list_tiles(
        shape, wide, sizes, pad, image, touched, visits, (_padded(entries), most)
    )
    pieces = _in_order(types, tile, *cut) if adjoint else None
    transpose = transpose_by_counting if types.backend == "llvm" else transpose_by_sorting
    splat, starts = transpose(types, grid.tiles, tile, last, entries, dr.width(tile))
    order, begin, end = _lanes(types, grid, starts, ordered and share.ordered)
    lists = TileLists(
        grid, sizes, splat, begin, end, order, image, pieces, dr.width(splat), steep, radius
    )
    dr.eval(lists)
    return lists


def steep_now(lists: TileLists, shape: list, radius: float) -> TileLists:
    """Return lists for Gaussians that have changed since, some of which may be steep now.

    Nothing is copied to the host, so that frozen programs can record it. A kernel then holds both
    ways to evaluate weights, and the one that is taken gives the bits that it gives alone.

    Parameters
    ----------
    lists : TileLists
        With pieces.
    shape : list of 5 Float, shape (N,)
        The Gaussians as they are now.
    radius : float
    """
    if lists.steep is True:
        return lists
    assert lists.pieces is not None
    types = types_of(shape[0])
    # All write the same. Dr.Jit does it in the kernel that packs the parameters: a reduction would
    # take two more.
    found = dr.zeros(types.UInt, 1)
    dr.make_opaque(found)
    dr.scatter(found, 1, types.UInt(0), is_steep(shape, radius) & (lists.pieces.number > 0))
    return replace(lists, steep=found != 0)


def _images(types: ArrayTypes, count: int, grid: Grid) -> UInt | None:
    """Return the image of each of `count` Gaussians; None if there is only one image."""
    if grid.images == 1:
        return None
    image, _ = make_divisor(types, count // grid.images).divmod(dr.arange(types.UInt, count))
    dr.schedule(image)
    return image


def _padded(count: int) -> int:
    """Round a size up by at most a quarter, and by at most 2^20, to a multiple of 16.

    Frozen programs are traced again for another size, so that sizes should change seldom. For long
    lists a trace costs less than the memory would.
    """
    step = max(16, 1 << max(0, min(count.bit_length() - 3, 20)))
    return (count // step + 1) * step


@record
def _count_tiles(
    shape: list, radius: float, wide: FloatLike, grid: GridArrays, pad: FloatLike
) -> tuple[UInt, UInt]:
    """Return the number of tiles that each Gaussian touches, and totals for one copy to the host.

    The total holds the number of all entries, and 2^40 for each Gaussian that is steep.
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
    grid: GridArrays,
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
    grid: GridArrays,
    pad: FloatLike,
    image: UInt | None,
    slots: tuple[UInt, UInt],
    capacity: int,
) -> UInt:
    """Write the tiles of each Gaussian to its slots ``[start, last)``."""
    start, last = slots
    # Zeros, because rounding could let the two walks differ by a tile in different programs.
    tiles = dr.zeros(types.UInt, capacity)
    dr.make_opaque(tiles)
    first = types.UInt(0) if grid.image is None or image is None else image * grid.image.divisor

    def emit(tile: UInt, column: UInt, row: UInt, active: Bool, slot: UInt) -> UInt:
        tile = types.UInt(tile) + first
        dr.scatter(tiles, tile, slot, active & (slot < last))
        return slot + dr.select(active, types.UInt(1), 0)

    dr.schedule(for_each_tile(shape, radius, grid, emit, start, pad=pad, label="list tiles"), tiles)
    return tiles


def _find_tiles(
    types: ArrayTypes,
    shape: list,
    radius: FloatLike,
    grid: GridArrays,
    pad: FloatLike,
    image: UInt | None,
    slots: tuple[UInt, UInt],
    capacity: int,
) -> UInt:
    """Return the tiles of `_emit_tiles` with a lane for each, which walks the rows of its Gaussian.

    With a lane for each Gaussian, and one that adds all of its pieces, a GPU waits for the largest
    one: a fit of 2048x2048 pixels and 320,000 Gaussians took 5.7 s instead of 1.1 s (H200).
    """
    start, last = slots
    i, count = dr.arange(types.UInt, capacity), dr.opaque(types.UInt, dr.width(last))
    dr.eval(start, last)
    owner = _search(count, last, i + 1)
    real = owner < count
    own = [dr.gather(types.Float, row, owner, real) for row in shape]
    pad = pad if dr.width(pad) == 1 else dr.gather(types.Float, pad, owner, real)
    row, stop = tile_rows(own, radius, grid, pad)

    def visit(row: UInt, left: UInt, tile: UInt) -> tuple:
        first, last = tile_columns(own, radius, grid, row, pad)
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
    # Rounding could let the two walks differ by a tile in different programs.
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
    """Cut the tiles of every Gaussian into pieces of like length, at most the granularity.

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
    # In integers: a quotient of floats on cuda may round up to one more.
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
    """Return the pieces of `_cut` with a lane for each."""
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
"""Largest number of bits of one pass of the radix sort. A pass of Dr.Jit keeps the order of equal
keys up to 9 bits on cuda, where its counts fit into shared memory."""


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
    by_tile = transpose_pattern(tile.numpy()[:entries].view(np.int32), starts, number)
    splat = dr.empty(types.UInt, capacity)
    dr.eval(splat)
    memory = splat.numpy()  # on llvm a view: no second copy of the largest array
    memory[:entries], memory[entries:] = by_tile.indices, 0
    return splat, upload(types.UInt, by_tile.indptr.view(np.uint32))


def transpose_pattern(
    columns: NDArray[np.int32], starts: NDArray[np.int32], number: int
) -> csc_array:
    """Return the transpose of a sparse pattern of rows, with its indices in ascending order."""
    # The values mean nothing: memory that is never written takes no room.
    unused = np.empty(len(columns), np.int8)
    return csr_array((unused, columns, starts), shape=(len(starts) - 1, number)).tocsc()


def transpose_by_sorting(
    types: ArrayTypes, number: int, tile: UInt, last: UInt, entries: int, capacity: int
) -> tuple[UInt, UInt]:
    """Transpose by a stable radix sort of the bits that tiles need, on the device.

    The entries are in the order of Gaussians, and a stable sort by tile keeps it. No copy goes to
    the host, and numbers are in arrays: as literals, they would compile the programs again for
    every size. Parameters and results as for `transpose_by_counting`.
    """
    UInt, bits = types.UInt, (number - 1).bit_length()
    i, real = dr.arange(UInt, capacity), dr.opaque(UInt, entries)
    # Padding gets the largest key: it comes after the entries, and stays there.
    key = dr.select(i < real, dr.gather(UInt, tile, i), (1 << bits) - 1)
    owner = _search(dr.opaque(UInt, dr.width(last)), last, i + 1)
    key, splat = _sort_stably(key, dr.select(i < real, owner, 0), bits)
    return splat, _search(real, key, dr.arange(UInt, number + 1))


def _sort_stably(key: UInt, value: UInt, bits: int) -> tuple[UInt, UInt]:
    """Sort keys of some bits, and values by their keys, from the lowest digit to the highest.

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
    """Return how many of the first `size` values, which ascend, are below each bound.

    The steps depend on the number of bits of the width only, rounded up, so that few programs serve
    all sizes; `drjit.binary_search` has the size in its program.
    """
    UInt, found = type(values), dr.zeros(type(values), dr.width(bound))
    for bit in reversed(range(-(-dr.width(values).bit_length() // 4) * 4)):
        index = found + (1 << bit)
        valid = index <= size
        below = dr.gather(UInt, values, index - 1, valid) < bound
        found = dr.select(valid & below, index, found)
    return found


PACKET = 16
"""Lanes of a SIMD packet; those of AVX-512."""


def order_lanes(length: NDArray[np.int32], window: NDArray[np.int32]) -> NDArray[np.uint32]:
    """Return an order of lanes with like lengths in a packet, and packets dealt out evenly.

    Dr.Jit cuts a launch on llvm into blocks of neighbouring lanes, two for each core. Pieces leave
    a tenth to a third of their lanes empty, all at the end: the last block would have no work. In
    simulation, the longest thread had 1.27 times the mean work on 2 cores, 1.46 times on 16 and
    1.51 times on 64; dealt out 1.01, 1.10 and 1.15 times (512x512, 20,000 Gaussians).

    Parameters
    ----------
    length : ndarray of int32, shape (lanes,)
        Work of each lane.
    window : ndarray of int32, shape (lanes,)
        Numbers of the windows; a lane stays in its window, with its neighbours in space.

    Returns
    -------
    ndarray of uint32, shape (lanes,)
        By window, then by descending length; packets without work are spread among the others.
    """
    order = _descending(length, window)
    dealt = len(order) // PACKET * PACKET
    packets = order[:dealt].reshape(-1, PACKET)
    full = (length[packets[:, 0]] > 0) | (length[packets[:, -1]] > 0)
    place = np.empty(len(packets), np.uint16)  # NumPy sorts 16 bits fastest
    for kind in (full, ~full):
        place[kind] = np.linspace(0, 65535, kind.sum())
    packets = packets[np.argsort(place, kind="stable")]
    return np.concatenate([packets.ravel(), order[dealt:]])


def _descending(length: NDArray[np.int32], window: NDArray[np.int32]) -> NDArray[np.uint32]:
    """Return the stable order by window, then by descending length.

    A counting sort. Each window has as many keys as its longest list has entries, and one: all
    windows together have no more keys than the lists have entries, beside one for each window.
    """
    # Lanes of one window come in runs, the rows of its tiles.
    changes = np.flatnonzero(window[1:] != window[:-1]) + 1
    bounds = np.concatenate([[0], changes, [len(window)]])
    owner = window[bounds[:-1]]
    longest = np.zeros(int(owner.max()) + 1, np.int32)
    np.maximum.at(longest, owner, np.maximum.reduceat(length, bounds[:-1]))
    empty = np.cumsum(longest + 1, dtype=np.int32) - 1  # keys of lanes without work
    keys = np.repeat(empty[owner], np.diff(bounds)) - length
    starts = np.arange(len(keys) + 1, dtype=np.int32)
    keys = keys.astype(np.int32, copy=False)
    order: NDArray[np.int32] = transpose_pattern(keys, starts, int(empty[-1]) + 1).indices
    return order.view(np.uint32)

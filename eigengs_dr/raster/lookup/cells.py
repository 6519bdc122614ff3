"""Lists of the Gaussians near each cell of an image, in 16 bits an entry.

Lists hold numbers, not copies of parameters: a Gaussian stands in some 20 lists, and its parameters
take 32 bytes. A set of more Gaussians than 16 bits can number is cut into bands, each with rows of
parameters of its own; few Gaussians reach into two bands, and their rows are stored twice.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...backend.arrays import ArrayTypes, types_of, upload
from ...backend.types import Bool, Float, UInt
from ..binning.lists import build_lists
from ..binning.tiles import Grid
from ..parameters import pack_parameters

MOST = (1 << 16) - 1
"""Largest number of Gaussians of a band. Their numbers start at 1: row 0 of a band is blank."""

BLANK = (0.0, 0.0, 1.0, 0.0, 1.0)
"""Shape of a blank row, whose colours are 0."""

SIDE = 1.05
"""Side of cells in mean distances of Gaussians."""

NARROW = 0.75
"""Side of the cells of Gaussians that change: a point has 15 % fewer Gaussians to look at, in sums
and in their derivatives, but lists take twice the memory."""

RUN = 4
"""Numbers that a step of a sum reads at once, in one gather: two words of 32 bits."""


@dataclass(frozen=True)
class Cells:
    """Square cells of an image, and where their lists begin.

    Numbers are in arrays: lists of Gaussians that have moved may have other cells, and a frozen
    program would not notice other numbers.

    Attributes
    ----------
    starts : UInt32, shape (cells + 1,)
        Index in `CellLists.runs` of the first run of each cell.
    density : Float, shape (1,)
        Cells in a pixel, along x or y.
    columns, rows : UInt32, shape (1,)
    """

    starts: UInt
    density: Float
    columns: UInt
    rows: UInt


@dataclass(frozen=True)
class CellLists:
    """The Gaussians that may touch each cell, for one or several divisions of an image into cells.

    Attributes
    ----------
    count : int
        Number of Gaussians.
    levels : list of Cells
    runs : UInt32, shape (2 * runs,)
        Numbers of 16 bits, in runs of `RUN`: rows of parameters, counted from the first row of the
        band. 0 is the blank row, which fills the last run of a list.
    gaussian : UInt32, shape (rows,), or None
        Gaussian of each row of parameters; `count` for a blank row. None for one band, where the
        Gaussians follow the blank row in their order, and where nobody will pack parameters.
    first : UInt32, shape (bands,)
        First row of each band.
    density : Float, shape (1,)
        Bands in a pixel, along y.
    last : UInt32, shape (1,)
        Index of the last band.
    """

    count: int
    levels: list[Cells]
    runs: UInt
    gaussian: UInt | None
    first: UInt
    density: Float
    last: UInt

    @property
    def packs(self) -> bool:
        """Whether `pack` knows the rows: it does not after `once_packed`, with several bands."""
        return self.gaussian is not None or dr.width(self.first) == 1

    def once_packed(self) -> CellLists:
        """Return the lists without what only `pack` needs."""
        return replace(self, gaussian=None)

    def pack(self, shape: list, color: list) -> Float:
        """Store parameters (N,) in rows, as sums read them; differentiable."""
        values, blank = [*shape, *color], (*BLANK, *[0.0] * len(color))
        gaussian = self.gaussian
        if gaussian is None:
            assert self.packs
            return pack_parameters(values, blank)
        real, one = gaussian < self.count, dr.opaque(types_of(shape[0]).Float, 1.0)
        # A derivative that is both added to at indices and used elsewhere has lost parts in Dr.Jit
        # 1.5: the product makes a variable that is only gathered.
        rows = [
            dr.select(real, dr.gather(type(v), v * one, gaussian, real), b)
            for v, b in zip(values, blank, strict=True)
        ]
        return pack_parameters(rows)

    def rows_of(self, gaussian: NDArray[np.int64]) -> NDArray[np.uint32]:
        """Return the row of each of some Gaussians, or one of its rows."""
        if self.gaussian is None:
            return (gaussian + 1).astype(np.uint32)
        stored = self.gaussian.numpy()
        row = np.zeros(self.count + 1, np.uint32)
        row[stored] = np.arange(len(stored))
        return row[gaussian]

    def range_at(self, cells: Cells, x: Float, y: Float, active: Bool) -> tuple[UInt, UInt]:
        """Return begin and end of the runs at a point of the image; else both are 0."""
        types = types_of(x)
        # The last cells include the right and the lower border.
        column = dr.minimum(types.UInt(x * cells.density), cells.columns - 1)
        row = dr.minimum(types.UInt(y * cells.density), cells.rows - 1)
        cell = row * cells.columns + column
        begin = dr.gather(types.UInt, cells.starts, cell, active)
        return begin, dr.gather(types.UInt, cells.starts, cell + 1, active)

    def numbers_at(self, types: ArrayTypes, run: UInt, active: Bool) -> list:
        """Return the `RUN` numbers of a run."""
        words = dr.gather(types.UInt2, self.runs, run, active)
        return [number for word in words for number in (word & 0xFFFF, word >> 16)]

    def first_at(self, y: Float) -> UInt | int:
        """Return the first row of the band at a height in the image."""
        if dr.width(self.first) == 1:
            return 0
        types = types_of(y)
        band = dr.minimum(types.UInt(dr.maximum(y, 0) * self.density), self.last)
        return dr.gather(types.UInt, self.first, band)


def cell_side(width: int, height: int, count: int, side: float = SIDE) -> int:
    """Return the side of cells in pixels, for a side in mean distances of Gaussians."""
    return max(1, round(side * math.sqrt(width * height / count)))


def list_cells(
    levels: Sequence[tuple[list, int]], width: int, height: int, radius: float
) -> CellLists:
    """List the Gaussians of every cell of an image.

    Parameters
    ----------
    levels : sequence of (list of 5 Float (N,), int)
        For each division of the image into cells: the shapes of the Gaussians, as for
        `eigengs_dr.raster.evaluate.weights`, and the side of a cell in pixels. Every side divides
        the last one.
    width, height : int
        Size of the image, in pixels.
    radius : float
        Cutoff in the units of the factor.

    Raises
    ------
    ValueError
        If more than `MOST` Gaussians touch one row of cells.
    """
    types, count = types_of(levels[0][0][0]), dr.width(levels[0][0])
    grids = [Grid(width, height, (side, side)) for _, side in levels]
    lists = [_lists(shape, grid, radius) for (shape, _), grid in zip(levels, grids, strict=True)]
    numbered = _number(count, height, grids, lists)
    found, starts, total = [], [], 0
    for entries, (_, ends) in zip(numbered.entries, lists, strict=True):
        lengths = np.diff(ends)
        begin = np.concatenate([[0], np.cumsum(-(-lengths // RUN))])
        filled = np.zeros(RUN * begin[-1], np.uint16)
        filled[np.repeat(RUN * begin[:-1] - ends[:-1], lengths) + np.arange(ends[-1])] = entries
        found.append(filled)
        starts.append(upload(types.UInt, (total + begin).astype(np.uint32)))
        total += int(begin[-1])
    gaussian = numbered.gaussian
    joint = np.concatenate(found) if total else np.zeros(RUN, np.uint16)
    cells = []
    for grid, start in zip(grids, starts, strict=True):
        density = dr.opaque(types.Float, 1 / grid.tile[0])
        columns, rows = (dr.opaque(types.UInt, n) for n in (grid.nx, grid.ny))
        cells.append(Cells(start, density, columns, rows))
    return CellLists(
        count,
        cells,
        upload(types.UInt, joint.view(np.uint32)),
        None if gaussian is None else upload(types.UInt, gaussian.astype(np.uint32)),
        upload(types.UInt, numbered.first.astype(np.uint32)),
        dr.opaque(types.Float, 1 / numbered.band),
        dr.opaque(types.UInt, len(numbered.first) - 1),
    )


def _lists(shape: list, grid: Grid, radius: float) -> tuple[NDArray[np.uint32], NDArray[np.int64]]:
    """Return the Gaussians of all cells, cell after cell, and the ends of their lists."""
    # Lists are built for pixel centres; half a pixel of padding makes them valid for all points.
    lists = build_lists(shape, radius, grid, pad=0.5, adjoint=False, ordered=False)
    ends = np.concatenate([[0], lists.end.numpy()]).astype(np.int64)
    return lists.splat.numpy()[: ends[-1]].astype(np.uint32, copy=False), ends


@dataclass(frozen=True)
class _Numbered:
    """Rows of parameters, and the lists in numbers of rows; see `CellLists`."""

    gaussian: NDArray[np.int64] | None
    first: NDArray[np.int64]
    band: int
    entries: list[NDArray[np.uint16]]


def _number(count: int, height: int, grids: list[Grid], lists: list) -> _Numbered:
    """Number the Gaussians of as few bands as possible, of equal height."""
    if count <= MOST:
        entries = [(splat + 1).astype(np.uint16) for splat, _ in lists]
        return _Numbered(None, np.zeros(1, np.int64), height, entries)
    side, rows = grids[-1].tile[1], grids[-1].ny
    bands = 2
    while True:
        band = side * -(-rows // bands)
        parts = [_cut(height, band, grid, *one) for grid, one in zip(grids, lists, strict=True)]
        members = [_members(count, cut) for cut in zip(*parts, strict=True)]
        if max(map(len, members)) <= MOST:
            break
        if bands >= rows:
            raise ValueError(
                f"more than {MOST:,} Gaussians touch {side} rows of pixels: use fewer or smaller "
                "Gaussians"
            )
        bands = min(2 * bands, rows)
    entries = [np.concatenate(cut) for cut in _local(count, members, parts)]
    rest = np.setdiff1d(np.arange(count), np.concatenate(members))
    sizes = [1 + len(m) for m in members]
    gaussian = np.concatenate([*(np.concatenate([[count], m]) for m in members), rest])
    return _Numbered(gaussian, np.cumsum([0, *sizes[:-1]]), band, entries)


def _cut(
    height: int, band: int, grid: Grid, splat: NDArray[np.uint32], ends: NDArray[np.int64]
) -> list[NDArray[np.uint32]]:
    """Cut lists at the borders of bands."""
    rows = np.minimum(np.arange(0, height + band, band) // grid.tile[1], grid.ny)
    ends = ends[rows * grid.nx]
    return [splat[begin:end] for begin, end in pairwise(ends)]


def _members(count: int, lists: Sequence[NDArray[np.uint32]]) -> NDArray[np.int64]:
    """Return the Gaussians in some lists, in ascending order."""
    listed = np.zeros(count, bool)
    for splat in lists:
        listed[splat] = True
    return np.flatnonzero(listed)


def _local(count: int, members: list, parts: list) -> list[list[NDArray[np.uint16]]]:
    """Return the parts of lists in the numbers of their bands."""
    number = np.zeros(count, np.uint16)
    found: list[list[NDArray[np.uint16]]] = [[] for _ in parts]
    for band, inside in enumerate(members):
        number[inside] = np.arange(1, len(inside) + 1)
        for cut, into in zip(parts, found, strict=True):
            into.append(number[cut[band]])
    return found

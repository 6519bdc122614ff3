"""Lists of the Gaussians near each cell of an image, with 16 bits per entry.

Lists hold numbers, not copies of parameters: a Gaussian stands in some 20 lists, and its row takes
16 or 32 bytes. A set of more Gaussians than 16 bits can number is cut into bands, each with rows of
parameters of its own; few Gaussians reach into two bands, and their rows are stored twice.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...backend.arrays import ArrayTypes, types_of, upload, upload_rows
from ...backend.types import Bool, Float, UInt
from ..lists import TileLists, build_lists
from ..parameters import pack_parameters
from ..tiles import Grid

MOST = (1 << 16) - 1
"""Largest number of Gaussians of a band. Their numbers start at 1: row 0 of a band is blank."""

BLANK = (0.0, 0.0, 1.0, 0.0, 1.0)
"""Shape of a blank row, whose colours are 0."""

SIDE = 1.05
"""Side of cells in mean distances of Gaussians."""

RUN = 4
"""Numbers that a step of a sum reads at once, in one gather: two words of 32 bits."""

PAD = 0.5
"""Pixels by which lists enlarge Gaussians: what is right for pixel centres is then for points."""


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
    members : UInt32, shape (bands * words,), or None
        A bit for each Gaussian and band that it reaches into. The rows of a band are a blank one
        and its Gaussians in order; Gaussians of no band come last. None for a single band of all.
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
    members: UInt | None
    first: UInt
    density: Float
    last: UInt

    def pack(self, shape: list, color: list) -> Float:
        """Store parameters (N,) in rows, as sums read them; differentiable."""
        return self.pack_rows([*shape, *color], (*BLANK, *[0.0] * len(color)))

    def pack_rows(self, values: list, blank: Sequence[float]) -> Float:
        """Store numbers (N,) in rows, with others in the rows of no Gaussian; differentiable."""
        if self.members is None:
            return pack_parameters(values, blank)
        types = types_of(values[0])
        gaussian = upload(types.UInt, self._gaussian_of_rows())
        real, one = gaussian < self.count, dr.opaque(types.Float, 1.0)
        # A derivative that is both added to at indices and used elsewhere has lost parts in Dr.Jit
        # 1.5: the product makes a variable that is only gathered. Words are no factors.
        values = [v * one if dr.grad_enabled(v) else v for v in values]
        rows = [
            dr.select(real, dr.gather(type(v), v, gaussian, real), b)
            for v, b in zip(values, blank, strict=True)
        ]
        return pack_parameters(rows)

    def _gaussian_of_rows(self) -> NDArray[np.int64]:
        """Return the Gaussian of each row, `count` for a blank one, where there are several bands.

        The host finds it anew at each call: stored, it would take 4 bytes for each Gaussian.
        """
        assert self.members is not None
        listed = _unpack_bits(self.members.numpy(), dr.width(self.first), self.count)
        bands = [np.append(self.count, np.flatnonzero(band)) for band in listed]
        return np.concatenate([*bands, np.flatnonzero(~listed.any(axis=0))])

    def rows_of(self, gaussian: NDArray[np.int64]) -> NDArray[np.uint32]:
        """Return the row of each of some Gaussians, or one of its rows."""
        if self.members is None:
            return (gaussian + 1).astype(np.uint32)
        stored = self._gaussian_of_rows()
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


def cell_side(width: int, height: int, count: int, coarser: int = 1) -> int:
    """Return the side of cells in pixels, about `SIDE`, or a multiple of it."""
    return coarser * max(1, round(SIDE * math.sqrt(width * height / count)))


def list_cells(
    levels: Sequence[tuple[list, int]], width: int, height: int, radius: float
) -> CellLists:
    """List the Gaussians of every cell of an image.

    Cells are tiles of lists, whose entries the host numbers in bands and fills up to whole runs.
    Their order is that of the Gaussians.

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
    lists = [
        build_lists(shape, radius, Grid(width, height, (s, s)), PAD, adjoint=False, ordered=False)
        for shape, s in levels
    ]
    bands = _number(types, count, lists)
    parts, starts = [], [np.zeros(1, np.int64)]
    for one, numbers in zip(lists, bands.numbers, strict=True):
        begin, end = (v.numpy().astype(np.int64) for v in (one.begin, one.end))
        runs = -(-(end - begin) // RUN)
        first = starts[-1][-1] + np.append(0, np.cumsum(runs))
        part = np.zeros(RUN * int(runs.sum()), np.uint16)
        moved = np.repeat(RUN * (first[:-1] - first[0]) - begin, end - begin)
        part[moved + np.arange(len(moved))] = numbers[: len(moved)]
        parts.append(part)
        starts.append(first)
    filled = sum(map(len, parts))
    parts.append(np.zeros(RUN * _rounded(filled // RUN) - filled, np.uint16))
    words, *firsts = upload_rows(types.UInt, [np.concatenate(parts).view(np.uint32), *starts[1:]])
    cells = []
    for one, start in zip(lists, firsts, strict=True):
        density = dr.opaque(types.Float, 1 / one.grid.tile[0])
        columns, lines = (dr.opaque(types.UInt, n) for n in (one.grid.nx, one.grid.ny))
        cells.append(Cells(start, density, columns, lines))
    return CellLists(
        count,
        cells,
        words,
        bands.members,
        bands.first,
        dr.opaque(types.Float, 1 / bands.height),
        dr.opaque(types.UInt, dr.width(bands.first) - 1),
    )


def _rounded(runs: int) -> int:
    """Round a number of runs up, by 3 % or 8: a program is recorded for each size of its arrays."""
    step = max(8, 1 << max(0, runs.bit_length() - 6))
    return (runs // step + 1) * step


@dataclass(frozen=True)
class _Bands:
    """Rows of parameters, see `CellLists`, and for each level the numbers of its entries."""

    members: UInt | None
    first: UInt
    height: int  # of a band, in pixels
    numbers: list[NDArray[np.uint32]]


def _number(types: ArrayTypes, count: int, lists: list[TileLists]) -> _Bands:
    """Number the Gaussians of as few bands as possible, of equal height."""
    grid, splats = lists[-1].grid, [one.splat.numpy() for one in lists]
    if count <= MOST:
        return _Bands(None, dr.opaque(types.UInt, 0), grid.height, [s + 1 for s in splats])
    side, bands = grid.tile[1], 2
    while True:
        band = side * -(-grid.ny // bands)
        cuts = [_cut(one, band) for one in lists]
        listed = np.stack(
            [
                _listed(count, [splat[k] for splat, k in zip(splats, parts, strict=True)])
                for parts in zip(*cuts, strict=True)
            ]
        )
        if listed.sum(axis=1).max() <= MOST:
            break
        if bands >= grid.ny:
            raise ValueError(
                f"more than {MOST:,} Gaussians touch {side} rows of pixels: use fewer or smaller "
                "Gaussians"
            )
        bands = min(2 * bands, grid.ny)
    local, numbers = np.zeros(count, np.uint32), [np.zeros_like(splat) for splat in splats]
    for inside, parts in zip(listed, zip(*cuts, strict=True), strict=True):
        local[inside] = np.arange(1, inside.sum() + 1)
        for number, splat, part in zip(numbers, splats, parts, strict=True):
            number[part] = local[splat[part]]
    first = np.cumsum(np.append(0, 1 + listed[:-1].sum(axis=1)))
    bits, starts = upload_rows(types.UInt, [_pack_bits(listed), first])
    return _Bands(bits, starts, band, numbers)


def _cut(lists: TileLists, band: int) -> list[slice]:
    """Return the entries of each band, of some height in pixels."""
    grid = lists.grid
    ends = np.concatenate([[0], lists.end.numpy()])
    rows = np.minimum(np.arange(0, grid.height + band, band) // grid.tile[1], grid.ny)
    return [slice(*ends) for ends in pairwise(ends[rows * grid.nx].tolist())]


def _listed(count: int, lists: list[NDArray[np.uint32]]) -> NDArray[np.bool_]:
    """Return for each Gaussian whether it is in one of some lists."""
    listed = np.zeros(count, bool)
    for splat in lists:
        listed[splat] = True
    return listed


def _pack_bits(rows: NDArray[np.bool_]) -> NDArray[np.uint32]:
    """Store rows of booleans as bits, each row in whole words of 32 bits."""
    padded = np.pad(rows, ((0, 0), (0, -rows.shape[1] % 32)))
    return np.packbits(padded, axis=1).view(np.uint32).ravel()


def _unpack_bits(words: NDArray[np.uint32], rows: int, count: int) -> NDArray[np.bool_]:
    """Return the rows of `_pack_bits`, of `count` booleans each."""
    bits = np.ascontiguousarray(words).view(np.uint8).reshape(rows, -1)
    return np.unpackbits(bits, axis=1, count=count).astype(bool)

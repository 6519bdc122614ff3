"""Gaussians sorted by size and position, so that a footprint finds the Gaussians near it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import numpy as np

from ...backend.arrays import types_of, upload
from ...backend.types import Float, UInt
from ...gaussian.covariance import max_deviation
from ..evaluate import widen
from ..parameters import EXP2_SCALE, kernel_radius
from .cells import CellLists, cell_side, list_cells

MIN_CLASS_SIZE = 1.0
"""Largest standard deviation in the smallest size class, in pixels."""

CLASS_RATIO = 3.0
"""Ratio of the sizes of two classes. With a smaller ratio a lookup visits more rows of cells; with
a larger ratio it visits more Gaussians that miss the footprint."""

FOOTPRINT_REACH = 3.0
"""Half-width of a footprint, in standard deviations, in the search for copies of the image."""

LISTED_FOOTPRINTS = (0.25, 0.5, 1.0)
"""Standard deviations of the footprints for which cells list their Gaussians, in mean distances of
Gaussians. Two lists, without 0.5, take as much memory and 2 to 5 % more time of a rendering."""

COARSER = 2
"""Ratio of the sides of the cells of two lists: those for wider footprints may be larger."""


@dataclass(frozen=True)
class SizeClasses:
    """Gaussians sorted by size, and Gaussians of one size sorted by the cell of their mean.

    A class of the size s holds Gaussians whose largest standard deviation is at most s. A footprint
    can only see such a Gaussian if the mean lies in the ellipse of ``footprint + s^2``. This
    ellipse covers some rows of cells, and in each row the Gaussians are one range of `row`.

    Attributes
    ----------
    width, height : int
        Size of the image, in pixels.
    wrap : {"repeat", "mirror", "clamp", "sphere"}
        Continuation of the image outside its borders.
    row : UInt32, shape (entries,)
        Rows of parameters: class after class, row after row, cell after cell.
    starts : UInt32, shape (cells + 1,)
        Index in `row` of the first Gaussian of each cell.
    table : Float, shape (8 * classes,)
        For each class: s^2, first cell, columns, rows, 1 / side of a cell, origin of the cells, and
        two zeros.
    spreads : tuple of float
        Largest standard deviations of footprints, in pixels, for which `cells` list Gaussians.
    cells : CellLists
        A level for each of the `spreads`. It holds the Gaussians widened by it, whose ellipses
        contain those for smaller footprints. Lanes with footprints of several sizes share a loop.
    """

    width: int
    height: int
    wrap: str
    row: UInt
    starts: UInt
    table: Float
    spreads: tuple[float, ...]
    cells: CellLists


def classify_by_size(
    shape: list, width: int, height: int, cutoff: float, wrap: str, coarser: int = 1
) -> SizeClasses:
    """Sort Gaussians for `eigengs_dr.raster.lookup.prefilter.sum_prefiltered`.

    Parameters
    ----------
    shape : list of 5 Float, shape (N,)
        Mean x, mean y, a, b, c, as for `eigengs_dr.raster.evaluate.weights`.
    width, height : int
        Size of the image, in pixels.
    cutoff : float
        Standard deviations.
    wrap : {"repeat", "mirror", "clamp", "sphere"}
    coarser : int, optional
        Factor of the sides of cells.

    Returns
    -------
    SizeClasses
        Gaussians that are not finite, or so far from the image that they end before it, are left
        out.
    """
    types = types_of(shape[0])
    x, y, a, b, c = (np.array(s.numpy(), np.float64) for s in shape)
    # Dr.Jit writes lists while the host sorts.
    spreads, cells = _list_widened(shape, width, height, kernel_radius(cutoff), coarser)
    with np.errstate(all="ignore"):
        size = EXP2_SCALE * max_deviation(a, b, c)
        visible = np.isfinite(x + y + size) & (a > 0) & (c > 0)
        rank = np.ceil(np.log(size / MIN_CLASS_SIZE) / math.log(CLASS_RATIO))
    rank = np.where(visible, np.maximum(rank, 0), 0).astype(np.int64)
    order, counts, table, first = [], [], [], 0
    for k in np.unique(rank[visible]):
        indices = np.flatnonzero(visible & (rank == k))
        largest = min(max(float(size[indices].max()), 1e-12), 1e12)  # its square fits in float32
        # Means beyond this margin are farther from the image than the cutoff.
        origin = -cutoff * largest
        area = (width - 2 * origin) * (height - 2 * origin)
        length = max(
            largest, math.sqrt(area / (2 * len(indices)))
        )  # at most two cells per Gaussian
        columns, rows = (math.ceil((s - 2 * origin) / length) for s in (width, height))
        column, row = ((v[indices] - origin) // length for v in (x, y))
        near = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        cell = (row * columns + column)[near].astype(np.int64)
        order.append(indices[near][np.argsort(cell, kind="stable")])
        counts.append(np.bincount(cell, minlength=columns * rows))
        table.append([largest**2, first, columns, rows, 1 / length, origin, 0, 0])
        first += columns * rows
    starts = np.cumsum(np.concatenate([[0], *counts] if counts else [[0, 0]]))
    # gather_index reads pairs: the array must have an even length and must not be empty.
    entries = np.concatenate([*order, [0]]).astype(np.int64)
    entries = np.pad(entries, (0, len(entries) % 2))
    return SizeClasses(
        width,
        height,
        wrap,
        upload(types.UInt, cells.rows_of(entries)),
        upload(types.UInt, np.asarray(starts, np.uint32)),
        upload(types.Float, np.asarray(table or np.zeros((1, 8)), np.float32).ravel()),
        spreads,
        cells,
    )


def _list_widened(
    shape: list, width: int, height: int, radius: float, coarser: int
) -> tuple[tuple[float, ...], CellLists]:
    """List the Gaussians widened by each of `LISTED_FOOTPRINTS`, all in one array."""
    Float, count = types_of(shape[0]).Float, dr.width(shape)
    spacing, smallest = math.sqrt(width * height / count), cell_side(width, height, count, coarser)
    spreads, levels = tuple(k * spacing for k in LISTED_FOOTPRINTS), []
    for number, spread in enumerate(spreads):
        variance = dr.opaque(Float, (spread / EXP2_SCALE) ** 2)
        widened, _ = widen(shape, [variance, Float(0), variance])
        levels.append((widened, smallest * COARSER**number))
    return spreads, list_cells(levels, width, height, radius)

"""Gaussians sorted by size and position, so that a footprint finds the Gaussians near it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
import numpy as np

from ...backend.arrays import types_of, upload
from ...backend.types import Float, UInt
from ...gaussian.covariance import max_deviation
from ..evaluate import widen
from ..parameters import EXP2_SCALE, kernel_radius
from .points import Cells, cell_side, list_cells

MIN_CLASS_SIZE = 1.0
"""Largest standard deviation in the smallest size class, in pixels."""

CLASS_RATIO = 3.0
"""Ratio of the sizes of two classes. With a smaller ratio a lookup visits more rows of cells; with
a larger ratio it visits more Gaussians that miss the footprint."""

FOOTPRINT_REACH = 3.0
"""Half-width of a footprint, in standard deviations, in the search for copies of the image."""

LISTED_FOOTPRINTS = (0.7, 4.0)
"""Standard deviations of the footprints for which cells list their Gaussians, in pixels; most
lookups have such footprints. Cells of the second lists are twice as wide: lists of equal cells took
1.7 to 2.1 times the memory in all, at 20,000 Gaussians too much for copies in their order (9 % more
time of a rendering), and at 5,000 saved 2 %."""


@dataclass(frozen=True)
class SizeClasses:
    """Gaussians sorted by size, and Gaussians of one size sorted by the cell of their mean.

    A class of the size s holds Gaussians whose largest standard deviation is at most s. A footprint
    can only see such a Gaussian if the mean lies in the ellipse of ``footprint + s^2``. This
    ellipse covers some rows of cells, and in each row the Gaussians are one range of `splat`.

    Attributes
    ----------
    width, height : int
        Size of the image, in pixels.
    wrap : {"repeat", "mirror", "clamp"}
        Continuation of the image outside its borders.
    splat : UInt32, shape (entries,)
        Indices of Gaussians: class after class, row after row, cell after cell.
    starts : UInt32, shape (cells + 1,)
        Index in `splat` of the first Gaussian of each cell.
    table : Float, shape (8 * classes,)
        For each class: s^2, first cell, columns, rows, 1 / side of a cell, origin of the cells, and
        two zeros.
    listed : list of (float, Cells)
        Lists for footprints of up to this standard deviation. They hold the
        Gaussians widened by it, whose ellipses contain the ellipses for smaller footprints. All
        have one array `splat`: lanes with footprints of several sizes then share a loop.
    """

    width: int
    height: int
    wrap: str
    splat: UInt
    starts: UInt
    table: Float
    listed: list[tuple[float, Cells]]


def classify_by_size(shape: list, width: int, height: int, cutoff: float, wrap: str) -> SizeClasses:
    """Sort Gaussians for `eigengs_dr.raster.lookup.prefilter.sum_prefiltered`.

    Parameters
    ----------
    shape : list of 5 Float, shape (N,)
        Mean x, mean y, a, b, c, as for `eigengs_dr.raster.evaluate.weights`.
    width, height : int
        Size of the image, in pixels.
    cutoff : float
        Standard deviations.
    wrap : {"repeat", "mirror", "clamp"}

    Returns
    -------
    SizeClasses
        Gaussians that are not finite, or so far from the image that they end before it, are left
        out.
    """
    types = types_of(shape[0])
    x, y, a, b, c = (np.asarray(s.numpy(), np.float64) for s in shape)
    with np.errstate(all="ignore"):
        size = EXP2_SCALE * max_deviation(a, b, c)
        drawn = np.isfinite(x + y + size) & (a > 0) & (c > 0)
        rank = np.ceil(np.log(size / MIN_CLASS_SIZE) / math.log(CLASS_RATIO))
    rank = np.where(drawn, np.maximum(rank, 0), 0).astype(np.int64)
    order, counts, table, first = [], [], [], 0
    for k in np.unique(rank[drawn]):
        own = np.flatnonzero(drawn & (rank == k))
        largest = min(float(size[own].max()), 1e12)  # its square must be finite in float32
        # Means beyond this margin are farther from the image than the cutoff.
        side = max(largest, max(width, height) / 1024)
        origin = -cutoff * largest
        columns, rows = (math.ceil((s - 2 * origin) / side) for s in (width, height))
        column, row = ((v[own] - origin) // side for v in (x, y))
        near = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        cell = (row * columns + column)[near].astype(np.int64)
        order.append(own[near][np.argsort(cell, kind="stable")])
        counts.append(np.bincount(cell, minlength=columns * rows))
        table.append([largest**2, first, columns, rows, 1 / side, origin, 0, 0])
        first += columns * rows
    starts = np.cumsum(np.concatenate([[0], *counts] if counts else [[0, 0]]))
    # gather_index reads pairs: the array must have an even length and must not be empty.
    found = np.concatenate([*order, [0]])
    splat = np.pad(found, (0, len(found) % 2))
    return SizeClasses(
        width,
        height,
        wrap,
        upload(types.UInt, splat.astype(np.uint32)),
        upload(types.UInt, np.asarray(starts, np.uint32)),
        upload(types.Float, np.asarray(table or np.zeros((1, 8)), np.float32).ravel()),
        _list_widened(shape, width, height, kernel_radius(cutoff)),
    )


def _list_widened(shape: list, width: int, height: int, radius: float) -> list[tuple[float, Cells]]:
    """List the Gaussians widened by each of `LISTED_FOOTPRINTS`, all in one array."""
    Float = types_of(shape[0]).Float
    side = max(4, cell_side(width, height, dr.width(shape)))
    levels = []
    for coarseness, spread in enumerate(LISTED_FOOTPRINTS, 1):
        variance = dr.opaque(Float, (spread / EXP2_SCALE) ** 2)
        widened, _ = widen(shape, [variance, Float(0), variance])
        levels.append(list_cells(widened, width, height, radius, coarseness * side))
    splat = dr.concat([cells.splat for cells in levels])
    dr.eval(splat)
    listed, first = [], 0
    for spread, cells in zip(LISTED_FOOTPRINTS, levels, strict=True):
        ends = cells.ends + dr.opaque(type(splat), first)
        listed.append((spread, replace(cells, splat=splat, ends=ends)))
        first += dr.width(cells.splat)
    dr.eval(listed)
    return listed

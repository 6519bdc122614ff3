"""Splats sorted by size and place, so that a footprint finds those it may see."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ...backend.arrays import types_of, upload
from ...gaussian.covariance import max_deviation
from ..evaluate import widen
from ..parameters import EXP2_SCALE, kernel_radius
from .points import Cells, cell_side, list_cells

MIN_CLASS_SIZE = 1.0
"""Largest standard deviation, in pixels, of the smallest size that splats are sorted by."""

CLASS_RATIO = 3.0
"""Of one size to the next. More sizes are more rows to visit, fewer more splats in vain."""

LISTED_FOOTPRINTS = (1.0, 4.0)
"""Footprints, in pixels, for which cells list their splats: where most lookups fall."""


@dataclass(frozen=True)
class SizeClasses:
    """Splats sorted by size, and those of one size by the cell that holds their mean.

    A splat of the size s, its largest standard deviation being at most s, can only be seen by a
    footprint if its mean lies in the ellipse of ``footprint + s^2``: rows of cells of which each is
    one run of `splat`.

    Attributes
    ----------
    width, height : int
        Of the image.
    wrap : {"repeat", "mirror", "clamp"}
    count : int
        Number of sizes.
    splat : UInt32, shape (N,)
        Indices of splats: size after size, row after row, cell after cell.
    starts : UInt32, shape (cells + 1,)
        Where the splats of every cell begin in `splat`.
    table : Float, shape (8 count,)
        Of each size its square, first cell, columns, rows, 1 / side and origin of the cells.
    listed : list of (float, Cells)
        Lists for points inside of the image and footprints of up to this standard deviation: those
        of splats widened by it, whose ellipses contain those of smaller footprints.
    """

    width: int
    height: int
    wrap: str
    count: int
    splat: Any
    starts: Any
    table: Any
    listed: list


def classify_by_size(shape: list, width: int, height: int, cutoff: float, wrap: str) -> SizeClasses:
    """Sort splats for `sum_filtered`.

    Parameters
    ----------
    shape : list of 5 Float, shape (N,)
        Mean x, mean y and the factor a, b, c, as `eigengs_dr.raster.evaluate.weights` takes them.
    width, height : int
        Of the image, in pixels.
    cutoff : float
        In standard deviations.
    wrap : {"repeat", "mirror", "clamp"}
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
        largest = min(float(size[own].max()), 1e12)  # its square has to be a number
        # What is farther from the image leaves nothing in it.
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
    found = np.concatenate([*order, [0]])  # never empty, and even: it is read in pairs
    splat = np.pad(found, (0, len(found) % 2))
    return SizeClasses(
        width,
        height,
        wrap,
        len(table),
        upload(types.UInt, splat.astype(np.uint32)),
        upload(types.UInt, np.asarray(starts, np.uint32)),
        upload(types.Float, np.asarray(table or np.zeros((1, 8)), np.float32).ravel()),
        [(s, _cells_for(shape, width, height, cutoff, s)) for s in LISTED_FOOTPRINTS],
    )


def _cells_for(shape: list, width: int, height: int, cutoff: float, spread: float) -> Cells:
    types = types_of(shape[0])
    variance = dr.opaque(types.Float, (spread / EXP2_SCALE) ** 2)
    widened, _ = widen(shape, [variance, types.Float(0), variance])
    side = max(4, cell_side(width, height, dr.width(shape)))
    return list_cells(widened, width, height, kernel_radius(cutoff), side)

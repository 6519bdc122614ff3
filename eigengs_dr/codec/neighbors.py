"""What a decoder knows about the surroundings of a Gaussian before it has decoded it.

Gaussians are in the order of a Hilbert curve through their cells. Their parameters are coded in
passes: every 16th Gaussian, then those half way between, and so on. So each Gaussian but the first
ones has known neighbours on both sides, and a pass takes few calls. All numbers here are the same
on every machine, see `eigengs_dr.codec.exact_math`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .exact_math import log2

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

STRIDES = (8, 4, 2, 1)
"""Distances of the passes after the first one, along the curve."""

PLACES = (-3, -1, 1, 3)
"""Known neighbours, in strides."""

COARSE = 16
"""Bound of the number of squares for each Gaussian, where a window counts Gaussians."""


class Pass(NamedTuple):
    """The Gaussians of a pass.

    Attributes
    ----------
    rows : ndarray of int64, shape (n,)
    known : list of ndarray of int64, shape (n,)
        Neighbours that earlier passes coded; empty in the first pass.
    weight : list of ndarray of float64, shape (n,)
        Weights of the neighbours, whose sum is 1: they fall with the square of the distance.
    """

    rows: IntArray
    known: list[IntArray]
    weight: list[Array]

    def mean(self, values: Array) -> Array:
        """Return the weighted means of values (N,) of the neighbours, shape (n,)."""
        total = np.zeros(len(self.rows))
        for known, weight in zip(self.known, self.weight, strict=True):
            total = total + weight * values[known]
        return total


def passes_of(cells: IntArray) -> list[Pass]:
    """Divide Gaussians, in the order of the curve, into passes; cells have the shape (N, 2)."""
    index = np.arange(len(cells))
    passes = [Pass(index[:: 2 * STRIDES[0]], [], [])]
    for stride in STRIDES:
        rows = index[stride :: 2 * stride]
        known, weight = list[IntArray](), list[Array]()
        total = np.zeros(len(rows))
        for place in PLACES:
            other = rows + place * stride
            inside = (other >= 0) & (other < len(cells))
            other = np.clip(other, 0, len(cells) - 1)
            near = np.where(inside, 1 / (squared_distance(cells[rows], cells[other]) + 1), 0)
            known, weight, total = [*known, other], [*weight, near], total + near
        passes.append(Pass(rows, known, [w / total for w in weight]))
    return [found for found in passes if len(found.rows)]


def squared_distance(one: IntArray, other: IntArray) -> Array:
    """Return the squares of the distances of cells (N, 2)."""
    x, y = (one - other).T.astype(np.float64)
    return x * x + y * y


def crowding(cells: IntArray) -> list[Array]:
    """Return logarithms, shape (N,), that tell how near other Gaussians are.

    The numbers of Gaussians in a small and in a large window, and the square of the distance to the
    nearer neighbour along the curve.
    """
    corner = cells.min(axis=0)
    counts = [_count(cells - corner, shift, reach) for shift, reach in ((1, 1), (2, 2))]
    ends = squared_distance(cells[1:], cells[:-1])
    before, after = np.append(ends[:1], ends), np.append(ends, ends[-1:])
    if len(cells) == 1:
        before = after = np.zeros(1)
    return [*map(log2, counts), log2(np.minimum(before, after) + 1)]


def _count(cells: IntArray, shift: int, reach: int) -> Array:
    """Count Gaussians in windows of ``2 reach + 1`` squares a side, of ``2^shift`` cells."""
    while int(np.prod((cells.max(axis=0) >> shift) + 1)) > COARSE * len(cells) + 256:
        shift += 1
    x, y = (cells >> shift).T
    grid = np.zeros((int(y.max()) + 2 * reach + 2, int(x.max()) + 2 * reach + 2), np.int64)
    np.add.at(grid, (y + reach + 1, x + reach + 1), 1)
    sums = grid.cumsum(axis=0).cumsum(axis=1)
    side = 2 * reach + 1
    inside = sums[y + side, x + side] - sums[y, x + side] - sums[y + side, x] + sums[y, x]
    return inside.astype(np.float64)

"""A Hilbert curve: places that are near on it are near in the plane.

`hilbert_encode` numbers points along the curve; `hilbert_squares` walks through the pixels of an
image, one square of the image at a time.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]

# The order in which a Hilbert curve visits the quarters of a square, by state: as it is (0), with
# columns and rows swapped (1), with both counted from the other side (2), or both changes (3).
_RIGHT = np.array([[0, 0, 1, 1], [0, 1, 1, 0], [1, 1, 0, 0], [1, 0, 0, 1]], np.int32)

_LOW = _RIGHT[[1, 0, 3, 2]]

_STATE = np.arange(4, dtype=np.int8)[:, None] ^ np.array([1, 0, 0, 3], np.int8)
"""The state of the curve inside each quarter, in the order of the curve."""

_PLACE = np.argsort(2 * _RIGHT + _LOW, axis=1)
"""The place in this order of the quarter in column ``right`` and row ``low``, by state and
``2 right + low``."""

MAX_LEVELS = 24
"""Largest number of levels of `hilbert_encode`; an index then fits 48 bits."""

SQUARE = 512
"""Side of the squares of `hilbert_squares` in pixels: their arrays stay in the cache."""


def hilbert_encode(points: IntArray, levels: int) -> IntArray:
    """Return the Hilbert indices of points.

    Parameters
    ----------
    points : ndarray of int64, shape (N, 2)
        x, y from 0 to ``2^levels - 1``.
    levels : int
        Levels of the curve, at most `MAX_LEVELS`.

    Returns
    -------
    ndarray of int64, shape (N,)
        Indices from 0 to ``4^levels - 1``, one for every point of the square.

    Examples
    --------
    >>> hilbert_encode(np.array([[0, 0], [0, 1], [1, 1], [1, 0]]), 1)
    array([0, 1, 2, 3])
    """
    x, y = np.asarray(points, np.int64).T
    place, state = np.zeros_like(x), np.zeros(len(x), np.int8)
    for level in reversed(range(levels)):
        quarter = _PLACE[state, 2 * (x >> level & 1) + (y >> level & 1)]
        place, state = 4 * place + quarter, _STATE[state, quarter]
    return place


class Square(NamedTuple):
    """A square that a Hilbert curve fills before it goes on.

    Attributes
    ----------
    rows, columns : slice
        The part of the image inside the square.
    side : int
        Side of the square in pixels; it may overhang the image.
    state : int
        Which of the four orders the curve has inside the square.
    """

    rows: slice
    columns: slice
    side: int
    state: int

    def order(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return row and column of the pixels inside the image, in the order of the curve.

        Both have the shape (n,) and count from the first row and the first column of the square.
        """
        row, column = _order(self.side, self.state)
        height = self.rows.stop - self.rows.start
        width = self.columns.stop - self.columns.start
        if (height, width) == (self.side, self.side):
            return row, column
        inside = (row < height) & (column < width)
        return row[inside], column[inside]


def hilbert_squares(height: int, width: int) -> list[Square]:
    """Divide an image into squares in the order of a Hilbert curve through all its pixels.

    The curve covers the next power of two; the function drops what is outside the image.

    Parameters
    ----------
    height, width : int
        Size of the image in pixels.

    Returns
    -------
    list of Square
        Squares of `SQUARE` pixels a side, or one square if the image is smaller.
    """
    whole = 1 << max(height - 1, width - 1).bit_length()
    side = min(whole, SQUARE)
    found = zip(*(a.tolist() for a in _quarter(whole, side, 0, height, width)), strict=True)
    return [
        Square(
            slice(row, min(row + side, height)),
            slice(column, min(column + side, width)),
            side,
            state,
        )
        for row, column, state in found
    ]


@lru_cache(maxsize=4)  # the squares of an image have one side
def _order(side: int, state: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return row and column of all pixels of a square in the order of the curve."""
    row, column, _ = _quarter(side, 1, state, side, side)
    return row, column


def _quarter(
    side: int, stop: int, state: int, height: int, width: int
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int8]]:
    """Replace a square by its quarters, level by level, down to squares of the side `stop`.

    Return the first row, the first column and the state of each square inside the image, in the
    order of the curve. The cost is proportional to their number: nothing is sorted.
    """
    column = row = np.zeros(1, np.int32)
    states = np.full(1, state, np.int8)
    while side > stop:
        side >>= 1
        column = column[:, None] + side * _RIGHT[states]
        row = row[:, None] + side * _LOW[states]
        states = _STATE[states]
        inside = (column < width) & (row < height)
        column, row, states = column[inside], row[inside], states[inside]
    return row, column, states

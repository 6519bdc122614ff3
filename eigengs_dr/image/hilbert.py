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
_RIGHT = np.array([[0, 0, 1, 1], [0, 1, 1, 0], [1, 1, 0, 0], [1, 0, 0, 1]])

_STATE = np.arange(4, dtype=np.int8)[:, None] ^ np.array([1, 0, 0, 3], np.int8)
"""The state of the curve inside each quarter, in the order of the curve."""

_PLACE = np.argsort(2 * _RIGHT + _RIGHT[[1, 0, 3, 2]], axis=1)
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
    return _walk(x, y, levels)[0]


def _walk(
    x: IntArray, y: IntArray, levels: int, start: int = 0
) -> tuple[IntArray, NDArray[np.int8]]:
    """Return the indices of points on a curve with a state, and its states inside the points."""
    place, state = np.zeros_like(x), np.full(len(x), start, np.int8)
    for level in reversed(range(levels)):
        quarter = _PLACE[state, 2 * (x >> level & 1) + (y >> level & 1)]
        place, state = 4 * place + quarter, _STATE[state, quarter]
    return place, state


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
    levels = max(height - 1, width - 1).bit_length()
    side = min(1 << levels, SQUARE)
    low, right = np.indices((-(-height // side), -(-width // side))).reshape(2, -1)
    place, states = _walk(right, low, levels - side.bit_length() + 1)

    def part(number: int, length: int) -> slice:
        return slice(side * number, min(side * number + side, length))

    return [
        Square(part(int(low[k]), height), part(int(right[k]), width), side, int(states[k]))
        for k in np.argsort(place)
    ]


@lru_cache(maxsize=4)  # the squares of an image have one side
def _order(side: int, state: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return row and column of all pixels of a square in the order of the curve."""
    low, right = np.indices((side, side)).reshape(2, -1)
    place, _ = _walk(right, low, side.bit_length() - 1, state)
    order = np.empty(side * side, np.int32)
    order[place] = np.arange(side * side)
    row, column = np.divmod(order, np.int32(side))
    return row, column

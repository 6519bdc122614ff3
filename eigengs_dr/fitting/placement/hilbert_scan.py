"""The pixels of an image in the order of a Hilbert curve, one square of the image at a time."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# The order in which a Hilbert curve visits the quarters of a square, by state: as it is (0), with
# columns and rows swapped (1), with both counted from the other side (2), or both changes (3).
_RIGHT = np.array([[0, 0, 1, 1], [0, 1, 1, 0], [1, 1, 0, 0], [1, 0, 0, 1]], np.int32)


_LOW = _RIGHT[[1, 0, 3, 2]]


_STATE = np.arange(4, dtype=np.int8)[:, None] ^ np.array([1, 0, 0, 3], np.int8)


SQUARE = 512
"""Side of the squares of `hilbert_squares` in pixels: their arrays stay in the cache."""


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

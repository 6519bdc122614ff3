"""The pixels of an image in the order of a Hilbert curve."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# The order in which a Hilbert curve visits the quarters of a square, by state: as it is (0), with
# columns and rows swapped (1), with both counted from the other side (2), or both changes (3).
_RIGHT = np.array([[0, 0, 1, 1], [0, 1, 1, 0], [1, 1, 0, 0], [1, 0, 0, 1]], np.int32)


_LOW = _RIGHT[[1, 0, 3, 2]]


_STATE = np.arange(4, dtype=np.int8)[:, None] ^ np.array([1, 0, 0, 3], np.int8)


def hilbert_order(height: int, width: int) -> NDArray[np.int64]:
    """Return the pixel indices ``row * width + column`` in the order of a Hilbert curve.

    The curve covers the next power of two; the function drops squares outside the image. It
    replaces each square by its quarters, level by level, in O(height * width) without sorting.

    Parameters
    ----------
    height, width : int

    Returns
    -------
    ndarray of int64, shape (height * width,)
    """
    side = 1 << max(height - 1, width - 1).bit_length()
    column = row = np.zeros(1, np.int32)
    state = np.zeros(1, np.int8)
    while side > 1:
        side >>= 1
        column = column[:, None] + side * _RIGHT[state]
        row = row[:, None] + side * _LOW[state]
        state = _STATE[state]
        inside = (column < width) & (row < height)
        column, row, state = column[inside], row[inside], state[inside]
    return row.astype(np.int64) * width + column

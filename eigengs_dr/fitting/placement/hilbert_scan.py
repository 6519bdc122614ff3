"""The pixels of an image in the order of a Hilbert curve."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# A Hilbert curve through a square visits its quarters in this order, the plain way (state 0) or
# with columns and rows swapped (1), with both counted from the other side (2), or both (3).
_RIGHT = np.array([[0, 0, 1, 1], [0, 1, 1, 0], [1, 1, 0, 0], [1, 0, 0, 1]], np.int32)


_LOW = _RIGHT[[1, 0, 3, 2]]


_STATE = np.arange(4, dtype=np.int8)[:, None] ^ np.array([1, 0, 0, 3], np.int8)


def hilbert_order(height: int, width: int) -> NDArray[np.int64]:
    """Pixel indices ``row * width + column`` in the order of a Hilbert curve over the image.

    The curve over the next power of two is followed, and what lies outside the image left out.
    Each square is replaced by its quarters, level by level: O(height * width), nothing is sorted.
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

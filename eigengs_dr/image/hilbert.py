"""A Hilbert curve: places that are near on it are near in the plane."""

from __future__ import annotations

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

"""The Hilbert index of points with integer coordinates: neighbours on the curve are near in space.

Gaussians near by are the context of each other in packed files.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]

MAX_LEVELS = 24
"""Largest number of levels of the curve; an index then fits 48 bits."""


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
    place = np.zeros_like(x)
    for level in reversed(range(levels)):
        right, low = x >> level & 1, y >> level & 1
        place = place * 4 + (3 * right ^ low)
        x, y = _rotate(x, y, right, low, (1 << level) - 1)
    return place


def _rotate(
    x: IntArray, y: IntArray, right: IntArray, low: IntArray, last: int
) -> tuple[IntArray, IntArray]:
    """Return coordinates in the frame of the curve in a quarter; the map is its own inverse."""
    x, y = x & last, y & last
    mirrored = (low == 0) & (right == 1)
    x, y = np.where(mirrored, last - x, x), np.where(mirrored, last - y, y)
    swapped = low == 0
    return np.where(swapped, y, x), np.where(swapped, x, y)

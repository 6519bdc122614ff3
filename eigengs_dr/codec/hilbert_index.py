"""A Hilbert curve through points with whole coordinates: neighbours on it are neighbours in space.

N points in the order of the curve need no order of their own: of all the ways to list them one is
left, which saves ``log2(N!)`` bits where the steps along the curve are stored.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]

MAX_LEVELS = 24
"""Of squares within squares: places along the curve then fit 48 bits."""


def hilbert_encode(points: IntArray, levels: int) -> IntArray:
    """Find where on the curve points lie.

    Parameters
    ----------
    points : ndarray of int64, shape (N, 2)
        x, y from 0 to ``2^levels - 1``.
    levels : int
        At most `MAX_LEVELS`.

    Returns
    -------
    ndarray of int64, shape (N,)
        From 0 to ``4^levels - 1``, one for every point of the square.

    Examples
    --------
    >>> along_curve(np.array([[0, 0], [0, 1], [1, 1], [1, 0]]), 1)
    array([0, 1, 2, 3])
    """
    x, y = np.asarray(points, np.int64).T
    place = np.zeros_like(x)
    for level in reversed(range(levels)):
        right, low = x >> level & 1, y >> level & 1
        place = place * 4 + (3 * right ^ low)
        x, y = _rotate(x, y, right, low, (1 << level) - 1)
    return place


def hilbert_decode(places: IntArray, levels: int) -> IntArray:
    """Find the points, shape (N, 2), at places along the curve: the inverse of `hilbert_encode`."""
    x = y = np.zeros_like(places)
    for level in range(levels):
        quarter = places >> 2 * level & 3
        right = quarter >> 1
        low = quarter & 1 ^ right
        x, y = _rotate(x, y, right, low, (1 << level) - 1)
        x, y = x + (right << level), y + (low << level)
    return np.stack([x, y], axis=1)


def _rotate(
    x: IntArray, y: IntArray, right: IntArray, low: IntArray, last: int
) -> tuple[IntArray, IntArray]:
    """Coordinates inside a quarter, as the curve runs there; turning back is the same."""
    x, y = x & last, y & last
    mirrored = (low == 0) & (right == 1)
    x, y = np.where(mirrored, last - x, x), np.where(mirrored, last - y, y)
    swapped = low == 0
    return np.where(swapped, y, x), np.where(swapped, x, y)

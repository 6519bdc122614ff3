"""The cells of Gaussians: their coding without an order, and their order on a Hilbert curve.

Without an order, N Gaussians take ``log2(N!)`` bits less. A square is halved until its parts are
single cells, alternately in x and in y. The number of Gaussians in one half, of n in both, follows
a beta-binomial distribution: Gaussians of a fit keep their distance, so that the numbers in the two
halves are more equal than by chance. The counts of large parts also show where Gaussians are dense.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from constriction import stream

from ..backend.types import Integers
from .range_coder import Coder, categorical

EVENNESS = (1, 2, 4, 8, 16, 64)
"""Possible parameters of the distribution: 1 is uniform, 64 gives nearly equal halves."""

MAX_MODELLED = 15
"""Largest number of Gaussians to which the distribution applies; larger numbers are rare."""


def code_cells(coder: Coder, cells: Integers, levels: int, evenness: int) -> Integers:
    """Code the cells of Gaussians in any order; return them in the order of `morton_encode`.

    Parameters
    ----------
    coder : Encoder or Decoder
    cells : ndarray of int64, shape (N, 2)
        Column and row of each cell; a decoder uses only their number.
    levels : int
        The square has ``2^levels`` cells per side.
    evenness : int
        One of `EVENNESS`.

    Returns
    -------
    ndarray of int64, shape (N, 2)
    """
    codes = np.sort(morton_encode(cells, levels))
    prefix, number = np.zeros(1, np.int64), np.array([len(cells)])
    for rest in reversed(range(2 * levels)):
        upper = np.cumsum(number) - np.searchsorted(codes, (2 * prefix + 1) << rest)
        upper = _code_halves(coder, number, evenness, upper)
        prefix = np.stack([2 * prefix, 2 * prefix + 1], axis=1).ravel()
        number = np.stack([number - upper, upper], axis=1).ravel()
        prefix, number = prefix[number > 0], number[number > 0]
    return morton_decode(np.repeat(prefix, number), levels)


def _code_halves(coder: Coder, number: Integers, evenness: int, upper: Integers) -> Integers:
    """Code how many Gaussians of each `number` lie in the second half."""
    result = np.zeros_like(number)
    kind = np.where(number > MAX_MODELLED, 1, number)
    for n in range(1, MAX_MODELLED + 1):
        rows = np.flatnonzero(kind == n)
        if n == 1 and len(rows):
            result[rows] = _any_number(coder, number[rows], upper[rows])
        elif len(rows):
            result[rows] = coder.code(_beta_binomial(n, evenness), upper[rows])
    return result


def _any_number(coder: Coder, number: Integers, upper: Integers) -> Integers:
    """Code integers from 0 to `number`, which may be large."""
    if number.max() < 1 << 20:
        return coder.uniform(number + 1, upper)
    result, factor = np.zeros_like(number), 1
    while factor <= number.max():  # 16-bit digits; damaged ones are clipped
        digit = upper // factor & 0xFFFF
        result += factor * coder.uniform(np.full(len(number), 1 << 16), digit)
        factor <<= 16
    return np.minimum(result, number)


@cache  # a tree of cells needs the models of small n repeatedly
def _beta_binomial(n: int, evenness: int) -> stream.model.Model:
    """Return the model of the number of n Gaussians in a half."""
    chances = [1.0]
    for k in range(n):
        chances.append(chances[-1] * (n - k) / (k + 1) * (k + evenness) / (n - k - 1 + evenness))
    return categorical(np.array(chances))


def morton_encode(cells: Integers, levels: int) -> Integers:
    """Return the interleaved bits of columns and rows (N, 2), highest first, as integers (N,)."""
    code = np.zeros(len(cells), np.int64)
    for level in range(levels):
        x, y = (cells >> level & 1).T
        code |= x << 2 * level + 1 | y << 2 * level
    return code


def morton_decode(codes: Integers, levels: int) -> Integers:
    """Return the columns and rows (N, 2) of integers (N,): the inverse of `morton_encode`."""
    x = y = np.zeros_like(codes)
    for level in range(levels):
        x, y = x | (codes >> 2 * level + 1 & 1) << level, y | (codes >> 2 * level & 1) << level
    return np.stack([x, y], axis=1)


# The order in which a Hilbert curve visits the quarters of a square, by state: unchanged (0), with
# columns and rows swapped (1), with both reversed (2), or with both changes (3).
_RIGHT = np.array([[0, 0, 1, 1], [0, 1, 1, 0], [1, 1, 0, 0], [1, 0, 0, 1]])

_STATE = np.arange(4, dtype=np.int8)[:, None] ^ np.array([1, 0, 0, 3], np.int8)
"""The state of the curve inside each quarter, in the order of the curve."""

_PLACE = np.argsort(2 * _RIGHT + _RIGHT[[1, 0, 3, 2]], axis=1)
"""Position in this order of the quarter in column ``right`` and row ``low``, by state and
``2 right + low``."""

MAX_LEVELS = 24
"""Largest number of levels of `hilbert_encode`; an index then fits into 48 bits."""


def hilbert_encode(points: Integers, levels: int) -> Integers:
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

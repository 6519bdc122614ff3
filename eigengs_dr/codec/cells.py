"""Cells of a plane as bits: how many Gaussians lie in each half of a square, and so on.

The order of N Gaussians is not stored, which saves ``log2(N!)`` bits. A square is halved until
its parts are single cells, once across and once along in turn. The number of Gaussians in a half,
of n in both, follows a beta-binomial distribution: Gaussians of a fit keep their distance, so
halves have more equal numbers than by chance. The counts of large parts also tell where Gaussians
are dense.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .range_coder import Coder, categorical

IntArray = NDArray[np.int64]

EVENNESS = (1, 2, 4, 8, 16, 64)
"""Parameters of the distribution that a file may name: 1 for any number, 64 nearly for halves."""

MAX_MODELLED = 15
"""Largest number of Gaussians whose halves have that distribution; larger ones are rare."""


def code_cells(
    coder: Coder, count: int, levels: int, evenness: int, cells: IntArray | None = None
) -> IntArray:
    """Code the cells of Gaussians in any order; return them in the order of `morton_encode`.

    Parameters
    ----------
    coder : Encoder or Decoder
    count : int
    levels : int
        The square has ``2^levels`` cells a side.
    evenness : int
        One of `EVENNESS`.
    cells : ndarray of int64, shape (count, 2), optional
        Column and row of each cell, for an encoder.

    Returns
    -------
    ndarray of int64, shape (count, 2)
    """
    codes = None if cells is None else np.sort(morton_encode(cells, levels))
    prefix, number = np.zeros(1, np.int64), np.array([count])
    for rest in reversed(range(2 * levels)):
        upper = None
        if codes is not None:
            ends = np.cumsum(number)
            upper = ends - np.searchsorted(codes, (2 * prefix + 1) << rest)
        upper = _code_halves(coder, number, evenness, upper)
        prefix = np.stack([2 * prefix, 2 * prefix + 1], axis=1).ravel()
        number = np.stack([number - upper, upper], axis=1).ravel()
        prefix, number = prefix[number > 0], number[number > 0]
    return morton_decode(np.repeat(prefix, number), levels)


def _code_halves(coder: Coder, number: IntArray, evenness: int, upper: IntArray | None) -> IntArray:
    """Code how many of each `number` of Gaussians lie in the second half."""
    result = np.zeros(len(number), np.int64)
    plain = (number == 1) | (number > MAX_MODELLED)
    groups = [plain, *(number == n for n in range(2, MAX_MODELLED + 1))]
    for n, chosen in enumerate(groups, 1):
        rows = np.flatnonzero(chosen)
        if not len(rows):
            continue
        given = None if upper is None else upper[rows]
        if n == 1:
            result[rows] = _any_number(coder, number[rows], given)
        else:
            result[rows] = coder.table(_beta_binomial(n, evenness), len(rows), given)
    return result


def _any_number(coder: Coder, number: IntArray, upper: IntArray | None) -> IntArray:
    """Code integers from 0 to `number`, which may be large."""
    result, factor = np.zeros(len(number), np.int64), 1
    if number.max() < 1 << 20:
        return coder.uniform(number + 1, upper)
    while factor <= number.max():  # digits of 16 bits; damaged ones are clipped
        given = None if upper is None else upper // factor & 0xFFFF
        result += factor * coder.uniform(np.full(len(number), 1 << 16), given)
        factor <<= 16
    return np.minimum(result, number)


@cache
def _beta_binomial(n: int, evenness: int) -> Any:
    """Return the model of the number of n Gaussians in a half."""
    chances = [1.0]
    for k in range(n):
        chances.append(chances[-1] * (n - k) / (k + 1) * (k + evenness) / (n - k - 1 + evenness))
    return categorical(np.array(chances))


def morton_encode(cells: IntArray, levels: int) -> IntArray:
    """Return the bits of columns and rows (N, 2) in turn, highest first, as integers (N,)."""
    code = np.zeros(len(cells), np.int64)
    for level in range(levels):
        x, y = (cells >> level & 1).T
        code |= x << 2 * level + 1 | y << 2 * level
    return code


def morton_decode(codes: IntArray, levels: int) -> IntArray:
    """Return the columns and rows (N, 2) of integers (N,): the inverse of `morton_encode`."""
    x = y = np.zeros_like(codes)
    for level in range(levels):
        x, y = x | (codes >> 2 * level + 1 & 1) << level, y | (codes >> 2 * level & 1) << level
    return np.stack([x, y], axis=1)

"""Entropy coding of integers by a range coder (Martin, "Range encoding", 1979) from constriction.

`Encoder` and `Decoder` have the same methods, which code an array of integers with given
probabilities: the encoder writes the integers and returns them, the decoder uses only their number
and returns those in the file. So the same function writes and reads a file, see
`eigengs_dr.codec.gaussian_model`.

Cells of Gaussians are coded without an order: N Gaussians take ``log2(N!)`` bits less. A square is
halved until its parts are single cells, alternately in x and in y. The number of Gaussians in one
half, of n in both, follows a beta-binomial distribution: Gaussians of a fit keep their distance, so
that the numbers in the two halves are more equal than by chance. The counts of large parts also
show where Gaussians are dense.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from constriction import stream

from ..backend.types import Doubles, Integers
from ..storage.npz import BadValue
from .exact_math import exp2, log2

HALF_TABLE = 64
"""Half the number of symbols of a table; numbers beyond are escaped."""

MAX_BITS = 50
"""Number of bits of the largest number."""

CHUNK_BITS = 16
"""Number of low bits that are coded at once."""

CLASSES_PER_OCTAVE = 3
"""Number of classes of widths per octave."""

MIN_CLASS, MAX_CLASS = -4 * CLASSES_PER_OCTAVE, 46 * CLASSES_PER_OCTAVE
"""Range of the classes of widths, from 2^-4 to 2^46."""

OFFSETS = 4
"""Number of fractional positions of the centre of a distribution."""

TAILS = (2, 4, 8)
"""Degrees of freedom of Student's distributions; the functions are algebraic for even ones."""

UNIFORM = stream.model.Uniform()


def categorical(probabilities: Doubles) -> stream.model.Model:
    """Return a model of the integers 0, 1, ... with probabilities given up to a factor."""
    return stream.model.Categorical(np.asarray(probabilities, float), perfect=False)


class Coder:
    """The part that both directions share: distributions built from `UNIFORM` and tables."""

    def code(self, model: stream.model.Model, values: Integers, *sizes: Integers) -> Integers:
        """Code integers by one model of the library, with its parameters for each integer."""
        raise NotImplementedError

    def uniform(self, sizes: Integers, values: Integers) -> Integers:
        """Code integers from 0 to ``sizes - 1`` with equal probabilities; sizes up to 2^20."""
        result = np.zeros(len(sizes), np.int64)
        free = sizes > 1  # a range coder has no distribution of one value
        if free.any():
            result[free] = self.code(UNIFORM, values[free], sizes[free].astype(np.int32))
        return result

    def numbers(self, center: Doubles, width: Doubles, tails: int, values: Integers) -> Integers:
        """Code integers with Student's distributions around centres.

        Parameters
        ----------
        center, width : ndarray of float64, shape (N,)
            Widths above 0.
        tails : int
            Degrees of freedom, one of `TAILS`.
        values : ndarray of int64, shape (N,)
        """
        center = np.clip(np.nan_to_num(center), -(2.0**40), 2.0**40)
        base = np.floor(center + 0.5)
        offset = np.floor((center - base + 0.5) * OFFSETS).astype(np.int64)
        octaves = log2(np.clip(np.nan_to_num(width), 2.0**-20, 2.0**45))
        kind = np.clip(np.rint(CLASSES_PER_OCTAVE * octaves), MIN_CLASS, MAX_CLASS).astype(np.int64)
        shift = _shift(kind)
        base = base.astype(np.int64)
        top, low = (values - base) >> shift, (values - base) & (1 << shift) - 1
        high = np.zeros_like(top)
        label = kind * OFFSETS + np.clip(offset, 0, OFFSETS - 1)
        order = np.argsort(label, kind="stable")
        ends = np.flatnonzero(np.diff(label[order], append=np.iinfo(np.int64).max)) + 1
        for rows in np.split(order, ends[:-1]):
            inside = np.clip(top[rows] + HALF_TABLE, 0, 2 * HALF_TABLE - 1)
            high[rows] = self.code(_student(int(label[rows[0]]), tails), inside) - HALF_TABLE
        for side, edge in ((-1, -HALF_TABLE), (1, HALF_TABLE - 1)):
            rows = np.flatnonzero(high == edge)
            high[rows] += side * self._unbounded(side * (top[rows] - edge))
        return base + (high << shift) + self._low_bits(shift, low)

    def _unbounded(self, values: Integers) -> Integers:
        """Code non-negative integers: the number of bits, then the bits."""
        bits = np.frexp((values + 1).astype(np.float64))[1].astype(np.int64) - 1
        bits = self.uniform(np.full(len(values), MAX_BITS), bits)
        return (1 << bits) + self._low_bits(bits, values + 1 - (1 << bits)) - 1

    def _low_bits(self, bits: Integers, values: Integers) -> Integers:
        """Code integers of known numbers of bits with equal probabilities."""
        result = np.zeros(len(bits), np.int64)
        for first in range(0, int(bits.max(initial=0)), CHUNK_BITS):
            length = np.clip(bits - first, 0, CHUNK_BITS)
            given = values >> first & (1 << length) - 1
            result += self.uniform(1 << length, given) << first
        return result


class Encoder(Coder):
    """Writes integers to bytes."""

    def __init__(self) -> None:
        self._coder = stream.queue.RangeEncoder()

    def code(self, model: stream.model.Model, values: Integers, *sizes: Integers) -> Integers:
        """Write integers; see `Coder.code`."""
        self._coder.encode(values.astype(np.int32), model, *sizes)
        return values

    def to_bytes(self) -> bytes:
        """Return all bytes."""
        return bytes(self._coder.get_compressed().astype("<u4").tobytes())


class Decoder(Coder):
    """Reads integers from bytes; damaged bytes give arbitrary integers, or `BadValue`."""

    def __init__(self, data: bytes) -> None:
        if len(data) % 4:
            raise BadValue("the size of the codes is not a multiple of 4 bytes")
        self._coder = stream.queue.RangeDecoder(np.frombuffer(data, "<u4").astype(np.uint32))

    def code(self, model: stream.model.Model, values: Integers, *sizes: Integers) -> Integers:
        """Read as many integers as there are values; see `Coder.code`."""
        try:
            decoded = self._coder.decode(model, *(sizes or (len(values),)))
        except (AssertionError, ValueError):
            raise BadValue("the codes are damaged") from None
        return np.asarray(decoded, np.int64)


def _shift(kind: Integers) -> Integers:
    """Return the number of low bits, coded without a table, of numbers of a class of widths."""
    return np.maximum(0, -(-kind // CLASSES_PER_OCTAVE) - 3)


@cache  # a few hundred models, each used for all numbers of its class
def _student(label: int, tails: int) -> stream.model.Model:
    """Return the model of the high parts of numbers of a class, see `Coder.numbers`."""
    kind, offset = divmod(label, OFFSETS)
    width = float(exp2(np.array(kind / CLASSES_PER_OCTAVE)))
    edges = np.arange(-HALF_TABLE, HALF_TABLE + 1) * float(1 << _shift(np.int64(kind))) - 0.5
    edges = (edges - ((offset + 0.5) / OFFSETS - 0.5)) / width
    below = _student_cdf(np.asarray(edges, np.float64), tails)
    below[0], below[-1] = 0.0, 1.0
    return categorical(np.maximum(np.diff(below), 1e-7))


def _student_cdf(t: Doubles, tails: int) -> Doubles:
    """Return Student's distribution function for 2, 4 or 8 degrees of freedom."""
    x = t / np.sqrt(tails + t * t)
    square = x * x
    if tails == 2:
        return 0.5 + 0.5 * x
    if tails == 4:
        return 0.5 + 0.25 * x * (3 - square)
    odd = x * (1 - square * (1 - square * (0.6 - square / 7)))
    return 0.5 + 1.09375 * odd


# --- Cells ---------------------------------------------------------------------------------------

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

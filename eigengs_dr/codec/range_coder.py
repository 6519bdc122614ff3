"""Entropy coding of integers by a range coder (Martin, "Range encoding", 1979) from constriction.

`Encoder` and `Decoder` have the same methods, which code an array of integers with given
probabilities: the encoder writes the integers and returns them, the decoder uses only their number
and returns those in the file. So the same function writes and reads a file, see
`eigengs_dr.codec.gaussian_model`.
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

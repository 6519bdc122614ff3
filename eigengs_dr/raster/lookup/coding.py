"""Rows of Gaussians in words of 32 bits: half the memory of floats, without derivatives.

A Gaussian of three channels takes four words, and one of more channels half a word for each:

    x 18 bits, a 14 | y 18, c 14 | b 16, channel 16 | channel 16, channel 16

a and c, which are positive, are floats of 5 bits of exponent and 9 of mantissa; b and the channels
are halves, with a sign and 10 bits of mantissa. Means take the sign and a bit from a and c, since
their rounding grows with the size of the picture: of 8,000 Gaussians of a photo of 512 pixels it
alone leaves 83 dB, and that of a and c 75; with 16 bits and whole halves, 74 and 79. Exponents end
at `TOP`: a power of two brings the largest number to it or close below, so light of 100,000 keeps
as many bits as light of 1.

To decode a number, a shift puts its bits where a float has them. That float is too small by
2^112, since 5 bits of exponent count from 15 and 8 from 127; one product makes up for that and for
the power of two.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...backend.arrays import types_of, upload_rows
from ...backend.types import Doubles
from ..parameters import EXP2_SCALE

MEAN_BITS = 18
"""Bits of a coordinate of a mean."""

TOP, ORDERS = 16, 30
"""Binary exponents: that of the largest number, and by how much that of the smallest is lower."""

APART = 4
"""Distance of the powers of two: few sets then differ in them, and compile other programs."""

PLACE = 1 / 32
"""Largest error of a mean, in the smallest standard deviation of the set."""

FAINT = 2.0**-11
"""Largest colour that counts as none, in medians of its channel: what the median itself loses."""

FLOAT = 2.0**112
"""What a float is too small by if its exponent is one of 5 bits."""

LARGEST_POWER = 12
"""Largest power of two: its product with `FLOAT` is a float."""

SIGN_AND_HALF = 0x8FFFE000 - (1 << 32)
"""Mask of the sign and of the 15 bits from the fourth below it, as a signed integer."""

BLANK = float(np.uint32(0x3F801E00).view(np.float32))
"""First two words of a blank row: some mean, and a = c. The float is a normal one: threads may
flush others to zero."""


@dataclass(frozen=True)
class Coding:
    """What decodes the rows of a set.

    Numbers are literals of a program: in a call of a texture, each array takes a gather. Pictures
    of one size have one grid of means, unless Gaussians lie outside.

    Attributes
    ----------
    origin, step : (float, float)
        Of x and y: a mean is the origin plus a number of steps.
    powers : tuple of int
        Powers of two: of a, b, c, or of p, t, r of inverted shapes, and of each channel.
    """

    origin: tuple[float, float]
    step: tuple[float, float]
    powers: tuple[int, ...]

    @property
    def words(self) -> int:
        """Number of words of a row, without those that fill it up."""
        return 2 + (len(self.powers) + 1) // 2

    @property
    def blank(self) -> list[float]:
        """The words of a blank row, as floats."""
        return [BLANK, BLANK, *[0.0] * (self.words - 2)]

    def decode(self, words: list) -> tuple[list, list]:
        """Return the 5 numbers of the shape and the channels from the words of rows."""
        types = types_of(words[0])
        bits = [dr.reinterpret_array(types.UInt, word) for word in words]
        x, y = (
            dr.fma(types.Float(types.Int(word >> (32 - MEAN_BITS))), step, origin)
            for word, step, origin in zip(bits[:2], self.step, self.origin, strict=True)
        )
        a, c = ((word << 14) & 0x0FFFC000 for word in bits[:2])
        halves = [half for word in bits[2:] for half in (word, word << 16)]
        # The sign stays, and the shift copies it to three bits that the mask clears.
        b, *color = ((types.Int(half) >> 3) & SIGN_AND_HALF for half in halves[: len(self.powers)])
        steep, *bright = (FLOAT * 2.0**power for power in self.powers)
        a, b, c = (dr.reinterpret_array(types.Float, v) * steep for v in (a, b, c))
        color = [
            dr.reinterpret_array(types.Float, v) * factor
            for v, factor in zip(color, bright, strict=True)
        ]
        return [x, y, a, b, c], color


def encode_rows(
    shape: list, stored: list, color: list, size: tuple[int, int]
) -> tuple[Coding, list] | None:
    """Return what decodes the rows of Gaussians, and their words; None if they must stay floats.

    Floats stay in double precision; where a and c of the set differ by ``2^(ORDERS - APART)`` or
    more, or means would move by more than `PLACE`; and where the largest colour of a channel is
    above 2e8, or 2^15 times the median.

    Parameters
    ----------
    shape : list of 5 Float, shape (N,)
        As for `eigengs_dr.raster.evaluate.weights`.
    stored : list of 5 Float, shape (N,)
        The shape as rows hold it: the same, or `eigengs_dr.raster.evaluate.inverted`.
    color : list of Float, shape (N,)
    size : (int, int)
        Width and height of the image, in pixels.

    Returns
    -------
    (Coding, list of Float (N,)) or None
        The words are the bits of floats.
    """
    types, count = types_of(shape[0]), dr.width(shape)
    if types.bits == 64:
        return None
    dr.eval(shape, stored, color)
    rows = [np.broadcast_to(np.float64(v.numpy()), count) for v in (*stored, *color)]
    factor = [np.broadcast_to(np.float64(v.numpy()), count) for v in shape[2:]]
    if not np.isfinite([*rows, *factor]).all():
        return None
    x, y, a, b, c, *colors = rows
    grids = [_grid(v, side) for v, side in zip((x, y), size, strict=True)]
    (origin_x, origin_y), step = (tuple(column) for column in zip(*grids, strict=True))
    powers = (_power([a, b, c]), *(_power([v]) for v in colors))
    narrowest = EXP2_SCALE / math.sqrt(float(np.max(sum(f * f for f in factor))))
    if (
        max(powers) > LARGEST_POWER
        or max(step) / 2 > PLACE * narrowest
        or min(a.min(), c.min()) < _smallest(powers[0])
        or not all(_is_kept(v, power) for v, power in zip(colors, powers[1:], strict=True))
    ):
        return None
    coding = Coding((origin_x, origin_y), step, powers)
    places = [
        np.uint32(np.rint((v - origin) / width)) << (32 - MEAN_BITS)
        for v, (origin, width) in zip((x, y), grids, strict=True)
    ]
    first = [place | _float_bits(v, powers[0], 14) for place, v in zip(places, (a, c), strict=True)]
    halves = [_half(v, power) for v, power in zip((b, *colors), powers, strict=True)]
    halves += [np.zeros_like(halves[0])] * (len(halves) % 2)
    pairs = [high << 16 | low for high, low in zip(halves[::2], halves[1::2], strict=True)]
    words = [word.view(np.float32) for word in (*first, *pairs)]
    return coding, upload_rows(types.Float, words)


def _grid(means: Doubles, side: int) -> tuple[float, float]:
    """Return the origin and the step of a coordinate: over the image, and more in its quarters."""
    quarter = side / 4
    first = min(0.0, math.floor(means.min() / quarter) * quarter)
    last = max(float(side), math.ceil(means.max() / quarter) * quarter)
    return first, (last - first) / ((1 << MEAN_BITS) - 1)


def _power(rows: list[Doubles]) -> int:
    """Return the power of two over which the largest of some numbers is below ``2^TOP``."""
    exponent = math.frexp(max(float(np.abs(row).max()) for row in rows))[1] - TOP
    return APART * -(-exponent // APART)


def _smallest(power: int) -> float:
    """Return the smallest number above 0 that is kept over a power of two."""
    return float(2.0 ** (power + TOP - ORDERS))


def _is_kept(channel: Doubles, power: int) -> bool:
    """Return whether halves over a power of two hold a channel, but for what is `FAINT`."""
    size = np.abs(channel[channel != 0])
    return not len(size) or bool(_smallest(power) <= FAINT * np.median(size))


def _half(values: Doubles, power: int) -> NDArray[np.uint32]:
    """Return the sign, 5 bits of exponent and 10 of mantissa of numbers over a power of two."""
    return np.uint32(np.signbit(values)) << 15 | _float_bits(values, power, 13)


def _float_bits(values: Doubles, power: int, dropped: int) -> NDArray[np.uint32]:
    """Return the bits of absolute values over a power of two, rounded, without the last ones.

    Of what is too small none is left: some threads of Dr.Jit flush floats that are not normal.
    """
    size = np.abs(values)
    scaled = np.where(size < _smallest(power), 0, size / (FLOAT * 2.0**power))
    bits = scaled.astype(np.float32).view(np.uint32)
    return (bits + np.uint32(1 << (dropped - 1))) >> np.uint32(dropped)

"""Entropy coding of integers by zlib's Huffman codes.

A number is split, as in floating point, into a Huffman code for its leading bits and its low bits,
which are almost random and stored as they are. An adaptive model with a range coder would need
another dependency and take between 3 % less and 5 % more bytes: the planes are short, and have
outliers.
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from ..storage.npz import BadValue

IntArray = NDArray[np.int64]

MAX_BITS = 50
"""Bits of the largest number, with the sign."""

LEADING = (1, 2, 3, 4)
"""Candidates for the number of bits after the first in a code; each plane stores the best one."""

SIGNED = 8
"""Flag, stored with the number of bits, for values on both sides of a centre."""

CENTRE = np.dtype("<i2")


def encode(values: IntArray) -> bytes:
    """Encode a plane of integers, shape (N,), below ``2^48`` in absolute value."""
    signed = bool((values < 0).any())
    centre = int(np.clip(np.median(values), -(1 << 15), (1 << 15) - 1)) if signed else 0
    away = values - centre
    folded = np.where(away < 0, -2 * away - 1, 2 * away) if signed else values
    coded = (_encode_leading(folded, leading, signed) for leading in LEADING)
    head, *rest = min((parts for parts in coded if parts), key=lambda parts: sum(map(len, parts)))
    return b"".join([head, CENTRE.type(centre).tobytes(), *rest])


def decode(data: memoryview, count: int) -> tuple[IntArray, memoryview]:
    """Decode a plane of `count` numbers from the start of the data, which may be hostile.

    Parameters
    ----------
    data : memoryview
    count : int

    Returns
    -------
    values : ndarray of int64, shape (count,)
    rest : memoryview
        The data after the plane.

    Raises
    ------
    BadValue
        If the data do not start with a plane of `count` numbers.
    """
    head = bytes(data[: 1 + CENTRE.itemsize])
    if len(head) < 1 + CENTRE.itemsize or head[0] & ~SIGNED not in LEADING:
        raise BadValue("a plane of numbers has an invalid first byte")
    leading, signed = head[0] & ~SIGNED, bool(head[0] & SIGNED)
    stream = zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        codes = stream.decompress(data[len(head) :], count + 1)
    except zlib.error:
        raise BadValue("a plane of numbers is damaged") from None
    if len(codes) != count or not stream.eof:
        raise BadValue(f"a plane of numbers does not hold {count}")
    low = memoryview(stream.unused_data)
    folded, size = _join_bits(np.frombuffer(codes, np.uint8).astype(np.int64), low, leading)
    if signed:
        folded = np.where(folded & 1, -(folded + 1 >> 1), folded >> 1)
    return folded + int(np.frombuffer(head[1:], CENTRE)[0]), low[size:]


def _encode_leading(folded: IntArray, leading: int, signed: bool) -> list[bytes]:
    """Return head, codes and low bits; or an empty list if a code would not fit a byte."""
    shifted = folded + (1 << leading)
    width = np.frexp(shifted.astype(np.float64))[1].astype(np.int64) - 1 - leading
    codes = (width << leading) + (shifted >> width) - (1 << leading)
    if codes.max() > 255:
        return []
    # The codes hold no repeated sequences, which other strategies of zlib look for.
    stream = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS, 9, zlib.Z_HUFFMAN_ONLY)
    packed = stream.compress(codes.astype(np.uint8).tobytes()) + stream.flush()
    owner, shift = _bits(width)
    low = np.packbits((shifted[owner] >> shift & 1).astype(np.uint8)).tobytes()
    return [bytes([leading | SIGNED * signed]), packed, low]


def _bits(width: IntArray) -> tuple[IntArray, IntArray]:
    """Return the index of the number and the power of two of every low bit, highest bit first."""
    owner = np.repeat(np.arange(len(width)), width)
    start = np.cumsum(width) - width
    return owner, width[owner] - 1 - (np.arange(len(owner)) - start[owner])


def _join_bits(codes: IntArray, low: memoryview, leading: int) -> tuple[IntArray, int]:
    """Return the numbers, and the number of bytes of their low bits."""
    width = codes >> leading
    size = -(-int(width.sum()) // 8)
    if size > len(low) or width.max() > MAX_BITS - leading:
        raise BadValue("a plane of numbers claims more bits than the file holds")
    top = codes - (width << leading) + (1 << leading)
    return (top << width) + _read_mantissas(bytes(low[:size]), width) - (1 << leading), size


def _read_mantissas(low: bytes, width: IntArray) -> IntArray:
    """Return the low bits of every number, with memory independent of their number."""
    start, data = np.cumsum(width) - width, np.frombuffer(low + bytes(8), np.uint8)
    word = np.zeros(len(width), np.uint64)
    for k in range(8):  # the up to 57 bits lie in the eight bytes from their first bit on
        word = word << np.uint64(8) | data[(start >> 3) + k].astype(np.uint64)
    word <<= (start & 7).astype(np.uint64)
    # Two shifts, because a shift by 64, for a number without low bits, would be undefined.
    return (word >> (63 - width).astype(np.uint64) >> np.uint64(1)).astype(np.int64)

"""A section of an ``.egs`` file: some of its Gaussians, coded for themselves.

A section starts with its number of Gaussians, its length and its checksum (`HEAD`). Its body holds
a byte (`RICH` and an index in `EVENNESS`), the weights of a model (`eigengs_dr.codec.weights`), and
the words of a range coder: the cells, then all other integers (`eigengs_dr.codec.gaussian_model`).

The order of N Gaussians is not stored, which saves ``log2(N!)`` bits. A square is halved until
its parts are single cells, once across and once along in turn. The number of Gaussians in a half,
of n in both, follows a beta-binomial distribution: Gaussians of a fit keep their distance, so
halves have more equal numbers than by chance. The counts of large parts also tell where Gaussians
are dense.
"""

from __future__ import annotations

import struct
import zlib
from functools import cache
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..image.hilbert import hilbert_encode
from ..storage.npz import BadValue
from . import weights
from .gaussian_model import GaussianCoder
from .quantization import Steps, Symbols
from .range_coder import Coder, Decoder, Encoder, categorical

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


RICH = 0x80
"""Flag of a section that stores all weights, not only the first ones."""

HEAD = struct.Struct("<III")
"""Number of Gaussians, number of bytes that follow, and the CRC-32 of that number and the bytes."""


def section_to_bytes(section: Symbols, steps: Steps, corner: IntArray, levels: int) -> bytes:
    """Return the bytes of a section; sort its Gaussians in Hilbert-curve order.

    Parameters
    ----------
    section : Symbols
    steps : Steps
    corner : ndarray of int, shape (2,)
        Column and row of the first cell of the file.
    levels : int
        The square of cells has ``2^levels`` columns and rows.
    """
    body = _body(section, steps, corner, levels)
    count = len(section.cell)
    return HEAD.pack(count, len(body), section_check(count, body)) + body


def section_check(count: int, body: bytes) -> int:
    """Return the checksum of a section."""
    return zlib.crc32(body, zlib.crc32(count.to_bytes(4, "little")))


def read_body(file: BinaryIO, size: int, number: int) -> tuple[bytes, int]:
    """Read the next section of a file of some size; return its body and number of Gaussians.

    Raises
    ------
    BadValue
        If the section is cut off or damaged.
    """
    splats, length, check = HEAD.unpack(exactly(file, HEAD.size))
    if length > size - file.tell():
        raise BadValue(f"section {number} is cut off; copy the file again")
    # Every Gaussian takes at least one byte, so the length of the file bounds the memory.
    if not 1 <= splats <= length:
        raise BadValue(
            f"section {number} claims {splats} Gaussians in {length} bytes; copy the file again"
        )
    body = exactly(file, length)
    if section_check(splats, body) != check:
        raise BadValue(f"section {number} is damaged; copy the file again")
    return body, splats


def decode_body(body: bytes, splats: int, channels: int, levels: int, steps: Steps) -> Symbols:
    """Return the Gaussians of a section; the body may be hostile although the checksum is right.

    Raises
    ------
    BadValue
        If the body is none that `section_to_bytes` writes.
    """
    rich, evenness = bool(body[0] & RICH), body[0] & ~RICH
    if evenness >= len(EVENNESS):
        raise BadValue("the first byte is unknown")
    model, codes = weights.from_bytes(body[1:], channels, rich)
    coder = Decoder(codes[: len(codes) // 4 * 4])  # a short body is filled up with bytes
    with np.errstate(all="ignore"):  # the weights may be hostile
        cells = code_cells(coder, splats, levels, EVENNESS[evenness])
        cells = cells[np.argsort(hilbert_encode(cells, levels), kind="stable")]
        return GaussianCoder(coder, cells, model).code(channels, steps)


def exactly(file: BinaryIO, count: int) -> bytes:
    """Read `count` bytes, or raise BadValue."""
    data = file.read(count)
    if len(data) < count:
        raise BadValue("the file is cut off; copy it again")
    return data


def _body(section: Symbols, steps: Steps, corner: IntArray, levels: int) -> bytes:
    """Return the bytes of a section: with all weights, or with the first ones if this is less."""
    cells = section.cell - corner
    # Gaussians in one cell are sorted too, so that equal sets in any order give equal files.
    rest = np.column_stack(section[1:])
    order = np.lexsort([*rest.T[::-1], hilbert_encode(cells, levels)])
    given, evenness = section._replace(cell=cells).select(order), _evenness(cells, levels)
    few = len(cells) < weights.SMALL
    ways = [_code(given, steps, levels, evenness, rich) for rich in ((True, False)[: 1 + few])]
    body = min(ways, key=len)
    return body.ljust(len(cells), b"\0")  # a reader expects a byte for a Gaussian, or more


def _code(given: Symbols, steps: Steps, levels: int, evenness: int, rich: bool) -> bytes:
    coder = Encoder()
    code_cells(coder, len(given.cell), levels, EVENNESS[evenness], given.cell)
    walk = GaussianCoder(coder, given.cell, rich=rich)
    walk.code(given.color.shape[1], steps, given)
    head = bytes([evenness | RICH * rich]) + weights.to_bytes(walk.model, rich)
    return head + coder.to_bytes()


def _evenness(cells: IntArray, levels: int) -> int:
    """Return the index in `EVENNESS` for which the cells take the fewest bytes."""

    def size(index: int) -> int:
        coder = Encoder()
        code_cells(coder, len(cells), levels, EVENNESS[index], cells)
        return len(coder.to_bytes())

    return min(range(len(EVENNESS)), key=size)

"""A section of an ``.egs`` file: some of its Gaussians, coded for themselves.

A section starts with its number of Gaussians, its length and its checksum (`HEAD`). Its body holds
a byte (`RICH` and an index in `EVENNESS`), the weights of a model (`eigengs_dr.codec.weights`), and
the words of a range coder: the cells (`eigengs_dr.codec.cells`), then all other integers
(`eigengs_dr.codec.gaussian_model`).
"""

from __future__ import annotations

import struct
import zlib
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..storage.npz import BadValue
from . import weights
from .cells import EVENNESS, code_cells
from .gaussian_model import GaussianCoder
from .hilbert_index import hilbert_encode
from .quantization import Steps, Symbols
from .range_coder import Decoder, Encoder

IntArray = NDArray[np.int64]

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

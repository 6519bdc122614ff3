"""The ``.egs`` file format: Gaussians as integers, in sections that are read one by one.

All numbers are little endian. The file starts with a header (`_HEADER`), the background and a
checksum; the header of a set with maps is followed by their table.

The sections follow, each coded separately. A section starts with its number of Gaussians, its
length and its checksum (`HEAD`). Its body holds a byte (`RICH` and an index into `EVENNESS`), the
weights of a model (`eigengs_dr.codec.gaussian_model.SectionModel`), and the words of a range coder:
the cells (`eigengs_dr.codec.range_coder.code_cells`), then all other integers.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..backend.types import Integers
from ..image.color import MAX_CHANNELS
from ..image.space import SPACES
from ..storage.atomic import atomic_write
from ..storage.memory import check_content, open_regular
from ..storage.npz import BadValue, file_errors
from .gaussian_model import MIN_RICH_COUNT, GaussianCoder, SectionModel
from .quantization import Steps, Symbols
from .range_coder import EVENNESS, MAX_LEVELS, Decoder, Encoder, code_cells, hilbert_encode

SUFFIX = ".egs"

MAGIC = b"\x89EGS"
"""First bytes of a file. The first byte is not ASCII, so no text file starts with it."""

VERSION, MAPS_VERSION, LIGHTS_VERSION = 5, 6, 8
"""Versions of the format: for a set without maps, with a table of maps, and with a table of lights.
Earlier versions were never released, and are not read."""

MAX_SECTIONS = 1 << 12

MAX_LIGHTS_BYTES = 1 << 22
"""Largest size of a table of lights."""

_HEADER = struct.Struct("<4sBBBBHIIiiffdf")
"""Magic, version, space, channels, levels of the square of cells, sections, width, height, column
and row of the first cell, the steps, the cutoff, and the PSNR."""

_MAP = struct.Struct("<BBBd")
"""An entry of the table of maps, without its name; see `_map_table`."""

HEAD = struct.Struct("<III")
"""Number of Gaussians, number of bytes that follow, and the CRC-32 of that number and the bytes."""

DECODING, DECODING_CHANNEL = 384, 20
"""Memory that decoding takes in bytes, per Gaussian and for each of its channels, as measured."""

RICH = 0x80
"""Flag of a section that stores all weights, not just the first ones."""


class EgsContent(NamedTuple):
    """The content of a file.

    Attributes
    ----------
    sections : list of Symbols
        Gaussians, section by section.
    steps : Steps
    background : ndarray of float32, shape (C,)
    size : (int, int)
        Native width and height.
    space : str
        One of `eigengs_dr.image.space.SPACES`.
    cutoff : float
        Radius of a Gaussian in standard deviations.
    maps : tuple of (str, str, int, float)
        The name, space, number of channels and weight of each map of a set, whose colours and
        background are multiplied by the weights; empty for an image.
    psnr : float
        PSNR against the image in dB, see `eigengs_dr.packing.pack.PackResult`; NaN if unknown.
    lights : bytes
        The table of lights of planes, see `eigengs_dr.relight.packed.table_bytes`; else empty.
    """

    sections: list[Symbols]
    steps: Steps
    background: NDArray[np.float32]
    size: tuple[int, int]
    space: str
    cutoff: float
    maps: tuple[tuple[Any, ...], ...] = ()
    psnr: float = float("nan")
    lights: bytes = b""

    def all_symbols(self) -> Symbols:
        """Return the Gaussians of all sections."""
        return Symbols(*map(np.concatenate, zip(*self.sections, strict=True)))


def egs_bytes(packed: EgsContent) -> bytes:
    """Return the bytes of a file, with the Gaussians of each section in Hilbert-curve order."""
    cells = packed.all_symbols().cell
    corner = cells.min(axis=0)
    levels = int((cells - corner).max()).bit_length()
    head = _HEADER.pack(
        MAGIC,
        MAPS_VERSION if packed.maps else LIGHTS_VERSION if packed.lights else VERSION,
        SPACES.index(packed.space),
        len(packed.background),
        levels,
        len(packed.sections),
        *packed.size,
        *corner.tolist(),
        *packed.steps,
        packed.cutoff,
        packed.psnr,
    )
    head += packed.background.astype("<f4").tobytes() + _map_table(packed.maps)
    if packed.lights:
        head += len(packed.lights).to_bytes(4, "little") + packed.lights
    parts = [head, zlib.crc32(head).to_bytes(4, "little")]
    parts += [section_to_bytes(part, packed.steps, corner, levels) for part in packed.sections]
    return b"".join(parts)


def write_egs(path: str | os.PathLike[str], packed: EgsContent) -> int:
    """Write a file atomically; return its number of bytes."""
    content = egs_bytes(packed)
    with atomic_write(path) as temporary:
        return temporary.write_bytes(content)


def _map_table(maps: Sequence[tuple[Any, ...]]) -> bytes:
    """Return the table of maps; empty for an image.

    The first byte is the number of maps. Each map has the length of its name, the index of its
    space and its number of channels (one byte each), its weight (float64), and its name in ASCII.
    """
    parts = [bytes([len(maps)])] if maps else []
    for name, space, channels, weight in maps:
        parts += [_MAP.pack(len(name), SPACES.index(space), channels, weight), name.encode("ascii")]
    return b"".join(parts)


def section_to_bytes(section: Symbols, steps: Steps, corner: Integers, levels: int) -> bytes:
    """Return the bytes of a section, with its Gaussians in Hilbert-curve order.

    Parameters
    ----------
    section : Symbols
    steps : Steps
    corner : ndarray of int, shape (2,)
        Column and row of the first cell of the file.
    levels : int
        The square of cells has ``2^levels`` columns and rows.
    """
    cells, count = section.cell - corner, len(section.cell)
    # Gaussians in one cell are sorted too, so that the order of the set does not change the file.
    numbers = np.column_stack(section[1:])
    order = np.lexsort([*numbers.T[::-1], hilbert_encode(cells, levels)])
    symbols = section._replace(cell=cells).select(order)
    evenness = min(range(len(EVENNESS)), key=lambda k: len(_cells(cells, levels, k).to_bytes()))
    choices = [True, False] if count < MIN_RICH_COUNT else [True]
    body = min((_body(symbols, steps, levels, evenness, rich) for rich in choices), key=len)
    body = body.ljust(count, b"\0")  # a reader expects at least one byte per Gaussian
    return HEAD.pack(count, len(body), section_check(count, body)) + body


def _cells(cells: Integers, levels: int, evenness: int) -> Encoder:
    """Return an encoder that has coded cells with the given entry of `EVENNESS`."""
    coder = Encoder()
    code_cells(coder, cells, levels, EVENNESS[evenness])
    return coder


def _body(symbols: Symbols, steps: Steps, levels: int, evenness: int, rich: bool) -> bytes:
    """Return the body of a section, with all weights or only the first ones."""
    coder = _cells(symbols.cell, levels, evenness)
    gaussian_coder = GaussianCoder(coder, symbols.cell, rich=rich)
    gaussian_coder.code(symbols, steps)
    head = bytes([evenness | RICH * rich]) + gaussian_coder.model.to_bytes(rich)
    return head + coder.to_bytes()


def section_check(count: int, body: bytes) -> int:
    """Return the checksum of a section."""
    return zlib.crc32(body, zlib.crc32(count.to_bytes(4, "little")))


def read_egs(path: str | os.PathLike[str], sections: int | None = None) -> EgsContent:
    """Read a packed set; the file need not be trusted.

    Parameters
    ----------
    path : path-like
    sections : int, optional
        Number of sections to read; the rest of the file may be missing. By default all.

    Returns
    -------
    EgsContent

    Raises
    ------
    ValueError
        If the file is not a packed set, is damaged, truncated or newer than this package, or has
        fewer sections.
    OSError
        If the file cannot be opened.
    """
    with _opened(path) as file:
        levels, count, corner, content = _read_header(file)
        if sections is not None and not 1 <= sections <= count:
            raise BadValue(f"the file has {count} sections, not {sections}; ask for 1 to {count}")
        channels, total = len(content.background), 0
        for number in range(1, (sections or count) + 1):
            body, splats = read_body(file, number)
            total += splats
            check_content(path, total * (DECODING + DECODING_CHANNEL * channels))
            try:
                symbols = decode_body(body, splats, channels, levels, content.steps)
            except BadValue as error:
                raise BadValue(f"section {number}: {error}; copy the file again") from None
            content.sections.append(symbols._replace(cell=symbols.cell + corner))
        if sections is None and file.read(1):
            raise BadValue("data follow the last section; copy the file again")
        return content


def is_packed(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is a packed set; for errors see `open_regular`."""
    with open_regular(path) as file:
        return file.read(len(MAGIC)) == MAGIC


def read_egs_head(path: str | os.PathLike[str]) -> EgsContent:
    """Return the content of a packed set without its sections; errors as for `read_egs`."""
    with _opened(path) as file:
        return _read_header(file)[3]


def section_counts(path: str | os.PathLike[str]) -> list[int]:
    """Return the number of Gaussians per section, undecoded; errors as for `read_egs`."""
    with _opened(path) as file:
        _, count, *_ = _read_header(file)
        return [read_body(file, k + 1)[1] for k in range(count)]


@contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a file, and put its name into errors."""
    with open_regular(path) as file, file_errors(path):
        yield file


def _read_header(file: BinaryIO) -> tuple[int, int, Integers, EgsContent]:
    """Return the levels, the number of sections, the first cell, and the content without sections.

    Headers that `egs_bytes` never writes are rejected; `eigengs_dr.gaussian.file` checks the rest.
    """
    head = exactly(file, _HEADER.size)
    magic, version, space, channels, levels, count, *rest = _HEADER.unpack(head)
    if magic != MAGIC:
        raise BadValue("not a packed set of Gaussians; it may be damaged or of another kind")
    if version not in (VERSION, MAPS_VERSION, LIGHTS_VERSION):
        raise BadValue(
            f"version is {version}, but this package reads {VERSION}, {MAPS_VERSION} and "
            f"{LIGHTS_VERSION}; "
            + ("upgrade eigengs-dr" if version > LIGHTS_VERSION else "pack the set again")
        )
    width, height, x, y, color, cell, cutoff, psnr = rest
    background = exactly(file, 4 * channels)
    table, maps = _read_maps(file) if version == MAPS_VERSION else (b"", ())
    if version == LIGHTS_VERSION:
        table = _read_lights(file)
    if exactly(file, 4) != zlib.crc32(head + background + table).to_bytes(4, "little"):
        raise BadValue("the header is damaged; copy the file again")
    if version == MAPS_VERSION and not maps:
        raise BadValue("maps are none; give each name once")
    steps = Steps(color, cell)
    if not 1 <= channels <= MAX_CHANNELS:
        raise BadValue(f"the header claims {channels} channels, expected 1 to {MAX_CHANNELS}")
    if space >= len(SPACES) or levels > MAX_LEVELS:
        raise BadValue("the header holds unknown values; upgrade eigengs-dr")
    if not 1 <= count <= MAX_SECTIONS:
        raise BadValue(f"the header claims {count} sections, expected 1 to {MAX_SECTIONS}")
    if not all(0 < step < np.inf for step in steps):
        raise BadValue(f"the steps are {tuple(steps)}, expected numbers above 0")
    values = np.frombuffer(background, "<f4")
    content = EgsContent([], steps, values, (width, height), SPACES[space], cutoff, maps, psnr)
    if version == LIGHTS_VERSION:
        content = content._replace(lights=table[4:])
    return levels, count, np.array([x, y]), content


def _read_lights(file: BinaryIO) -> bytes:
    """Read a table of lights, with its length before it."""
    head = exactly(file, 4)
    length = int.from_bytes(head, "little")
    if not 1 <= length <= MAX_LIGHTS_BYTES:
        raise BadValue(f"the header claims {length} bytes of lights; copy the file again")
    return head + exactly(file, length)


def _read_maps(file: BinaryIO) -> tuple[bytes, tuple[tuple[Any, ...], ...]]:
    """Read a table of maps; return its bytes and the maps, which are not checked."""
    table, maps = exactly(file, 1), list[tuple]()
    for _ in range(table[0]):
        entry = exactly(file, _MAP.size)
        length, number, channels, weight = _MAP.unpack(entry)
        name = exactly(file, length)
        space = SPACES[number] if number < len(SPACES) else f"number {number}"
        maps.append((name.decode("ascii", "replace"), space, channels, weight))
        table += entry + name
    return table, tuple(maps)


def read_body(file: BinaryIO, number: int) -> tuple[bytes, int]:
    """Read the next section of a file, and return its body and its number of Gaussians.

    Raises
    ------
    BadValue
        If the section is truncated or damaged.
    """
    splats, length, check = HEAD.unpack(exactly(file, HEAD.size))
    if length > os.fstat(file.fileno()).st_size - file.tell():
        raise BadValue(f"section {number} is truncated; copy the file again")
    # Every Gaussian takes at least one byte, so the size of the file bounds the memory.
    if not 1 <= splats <= length:
        raise BadValue(
            f"section {number} claims {splats} Gaussians in {length} bytes; copy the file again"
        )
    body = exactly(file, length)
    if section_check(splats, body) != check:
        raise BadValue(f"section {number} is damaged; copy the file again")
    return body, splats


def decode_body(body: bytes, splats: int, channels: int, levels: int, steps: Steps) -> Symbols:
    """Return the Gaussians of a section; the body need not be trusted, despite the checksum.

    Raises
    ------
    BadValue
        If `section_to_bytes` cannot have written the body.
    """
    rich, evenness = bool(body[0] & RICH), body[0] & ~RICH
    if evenness >= len(EVENNESS):
        raise BadValue("the first byte is unknown")
    model, codes = SectionModel.from_bytes(body[1:], channels, rich)
    coder = Decoder(codes[: len(codes) // 4 * 4])  # a short body is padded
    with np.errstate(all="ignore"):  # the weights are not trusted
        scalars, pairs = np.zeros(splats, np.int64), np.zeros((splats, 2), np.int64)
        cells = code_cells(coder, pairs, levels, EVENNESS[evenness])
        cells = cells[np.argsort(hilbert_encode(cells, levels), kind="stable")]
        colors = np.zeros((splats, channels), np.int64)
        unknown = Symbols(cells, pairs, colors, scalars, scalars, scalars)
        return GaussianCoder(coder, cells, model).code(unknown, steps)


def exactly(file: BinaryIO, count: int) -> bytes:
    """Read `count` bytes, or raise BadValue."""
    data = file.read(count)
    if len(data) < count:
        raise BadValue("the file is truncated; copy it again")
    return data

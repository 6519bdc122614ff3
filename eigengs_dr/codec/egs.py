"""The ``.egs`` file format: Gaussians as integers, in sections that are read one by one.

All numbers are little endian. The file starts with a header (`_HEADER`), the background and a
checksum. The sections follow. A section starts with its number of Gaussians, its length and its
checksum (`_SECTION`). Its body holds a byte (`RICH` and an index in `EVENNESS`), the weights of a
model (`eigengs_dr.codec.weights`), and the words of a range coder: the cells
(`eigengs_dr.codec.cells`), then all other integers (`eigengs_dr.codec.gaussian_model`).
"""

from __future__ import annotations

import os
import struct
import zlib
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..gaussian.file import CUTOFF, SetData
from ..image.color import MAX_CHANNELS, SPACES
from ..material.maps import TextureMap, check_maps
from ..storage.atomic import atomic_write
from ..storage.npz import MAX_ENTRIES, BadValue
from . import weights
from .cells import EVENNESS, code_cells
from .egs_maps import maps_to_bytes, read_maps
from .gaussian_model import GaussianCoder
from .hilbert_index import MAX_LEVELS, hilbert_encode
from .quantization import Steps, Symbols, dequantize
from .range_coder import Decoder, Encoder

IntArray = NDArray[np.int64]

SUFFIX = ".egs"

MAGIC = b"\x89EGS"
"""First bytes of a file. The first byte is no ASCII character, so no text file starts with it."""

VERSION, MAPS_VERSION = 3, 4
"""Versions of the format, for an image and for a material, which has a table of maps. Versions 1
and 2, of packages before release, are not read."""

MAX_SECTIONS = 1 << 12

RICH = 0x80
"""Flag of a section that stores all weights, not only the first ones."""

_HEADER = struct.Struct("<4sBBBBHIIiiffd")
"""Magic, version, space, channels, levels of the square of cells, sections, width, height, column
and row of the first cell, the steps, and the cutoff."""

_SECTION = struct.Struct("<III")
"""Number of Gaussians, number of bytes that follow, and the CRC-32 of that number and the bytes."""

_CHECK = struct.Struct("<I")


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
        One of `eigengs_dr.image.color.SPACES`.
    cutoff : float
        Radius of a Gaussian in standard deviations.
    maps : tuple of TextureMap
        The maps of a material, whose colours and background are multiplied by their weights; empty
        for an image.
    """

    sections: list[Symbols]
    steps: Steps
    background: NDArray[np.float32]
    size: tuple[int, int]
    space: str
    cutoff: float = CUTOFF
    maps: tuple[TextureMap, ...] = ()

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return mean (N, 2), factor (N, 3), color (N, C) and background (C,), all of float32."""
        values = {**dequantize(self.whole(), self.steps), "background": self.background}
        with np.errstate(over="ignore"):
            return {name: value.astype(np.float32) for name, value in values.items()}

    def set_data(self) -> SetData:
        """Return the set; a material has the channels of all maps."""
        return SetData(self.arrays(), self.size, self.space, self.cutoff)

    def whole(self) -> Symbols:
        """Return the Gaussians of all sections."""
        return Symbols(*map(np.concatenate, zip(*self.sections, strict=True)))


def is_egs(path: str | os.PathLike[str]) -> bool:
    """Return whether a file starts with `MAGIC`; raise `OSError` if it cannot be opened."""
    with open(path, "rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def to_bytes(packed: EgsContent) -> bytes:
    """Return the bytes of a file; sort the Gaussians of each section in Hilbert-curve order."""
    cells = packed.whole().cell
    corner = cells.min(axis=0)
    levels = int((cells - corner).max()).bit_length()
    head = _HEADER.pack(
        MAGIC,
        MAPS_VERSION if packed.maps else VERSION,
        SPACES.index(packed.space),
        len(packed.background),
        levels,
        len(packed.sections),
        *packed.size,
        *corner.tolist(),
        *packed.steps,
        packed.cutoff,
    )
    head += packed.background.astype("<f4").tobytes() + maps_to_bytes(packed.maps)
    parts = [head, _CHECK.pack(zlib.crc32(head))]
    for section in packed.sections:
        body = _body(section, packed.steps, corner, levels)
        count = len(section.cell)
        parts += [_SECTION.pack(count, len(body), section_check(count, body)), body]
    return b"".join(parts)


def write(path: str | os.PathLike[str], content: bytes) -> None:
    """Write the result of `to_bytes` to a file atomically.

    Raises
    ------
    OSError
        If the file cannot be written; an existing file then stays unchanged.
    """
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def read(path: str | os.PathLike[str], sections: int | None = None) -> EgsContent:
    """Read a packed set; the file may be hostile.

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
        If the file is no packed set, is damaged, cut off or newer than this package, or has fewer
        sections.
    OSError
        If the file cannot be opened.
    """
    path = Path(path)
    with path.open("rb") as file:
        try:
            return _read(file, os.fstat(file.fileno()).st_size, sections)
        except BadValue as error:
            raise ValueError(f"{path}: {error}") from None


def read_set(path: Path, sections: int | None = None) -> SetData:
    """Read a packed set for `eigengs_dr.Gaussians.load`; for parameters and errors see `read`."""
    content = read(path, sections)
    if content.maps:
        names = ", ".join(m.name for m in content.maps)
        raise ValueError(f"{path}: holds the maps {names}; load it by Material.load, take one")
    return content.set_data()


def section_check(count: int, body: bytes) -> int:
    """Return the checksum of a section."""
    return zlib.crc32(body, zlib.crc32(_CHECK.pack(count)))


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


def _read(file: BinaryIO, size: int, wanted: int | None) -> EgsContent:
    head = _exactly(file, 5)
    if head[:4] != MAGIC:
        raise BadValue("not a packed set of Gaussians; it may be damaged or something else")
    if head[4] not in (VERSION, MAPS_VERSION):
        raise BadValue(
            f"version is {head[4]}, but this package reads versions {VERSION} and {MAPS_VERSION}; "
            + ("upgrade eigengs-dr" if head[4] > VERSION else "pack the set again")
        )
    head += _exactly(file, _HEADER.size - len(head))
    _, _, space, channels, levels, count, width, height, *rest = _HEADER.unpack(head)
    background = _exactly(file, 4 * channels)
    table, maps = b"", tuple[TextureMap, ...]()
    if head[4] == MAPS_VERSION:
        table, maps = read_maps(partial(_exactly, file))
    (check,) = _CHECK.unpack(_exactly(file, _CHECK.size))
    if check != zlib.crc32(head + background + table):
        raise BadValue("the header is damaged; copy the file again")
    if maps:
        check_maps(maps, channels)
    corner, steps = np.array(rest[:2], np.int64), Steps(*rest[2:4])
    _check_header(space, channels, levels, count, steps)
    if wanted is not None and not 1 <= wanted <= count:
        raise BadValue(f"the file has {count} sections, not {wanted}; ask for 1 to {count}")
    found: list[Symbols] = []
    for number in range(1, (wanted or count) + 1):
        body, splats = _section(file, size, number)
        room = MAX_ENTRIES // max(3, channels) - sum(len(section.cell) for section in found)
        if splats > room:
            raise BadValue(
                f"section {number} claims {splats} Gaussians, but at most {room} more can be read"
            )
        try:
            symbols = _symbols(body, splats, channels, levels, steps)
        except BadValue as error:
            raise BadValue(f"section {number}: {error}; copy the file again") from None
        found.append(symbols._replace(cell=symbols.cell + corner))
    if wanted is None and file.read(1):
        raise BadValue("data follow the last section; copy the file again")
    return EgsContent(
        sections=found,
        steps=steps,
        background=np.frombuffer(background, "<f4"),
        size=(width, height),
        space=SPACES[space],
        cutoff=rest[4],
        maps=maps,
    )


def _check_header(space: int, channels: int, levels: int, count: int, steps: Steps) -> None:
    """Raise BadValue for headers that `to_bytes` never writes; `Gaussians.load` checks the rest."""
    if not 1 <= channels <= MAX_CHANNELS:
        raise BadValue(f"the header claims {channels} channels, expected 1 to {MAX_CHANNELS}")
    if space >= len(SPACES) or levels > MAX_LEVELS:
        raise BadValue("the header holds unknown values; upgrade eigengs-dr")
    if not 1 <= count <= MAX_SECTIONS:
        raise BadValue(f"the header claims {count} sections, expected 1 to {MAX_SECTIONS}")
    if not all(0 < step < np.inf for step in steps):
        raise BadValue(f"the steps are {tuple(steps)}, expected numbers above 0")


def _section(file: BinaryIO, size: int, number: int) -> tuple[bytes, int]:
    """Read the next section, check its checksum, and return its body and number of Gaussians."""
    splats, length, check = _SECTION.unpack(_exactly(file, _SECTION.size))
    if length > size - file.tell():
        raise BadValue(f"section {number} is cut off; copy the file again")
    # Every Gaussian takes at least one byte, so the length of the file bounds the memory.
    if not 1 <= splats <= length:
        raise BadValue(
            f"section {number} claims {splats} Gaussians in {length} bytes; copy the file again"
        )
    body = _exactly(file, length)
    if section_check(splats, body) != check:
        raise BadValue(f"section {number} is damaged; copy the file again")
    return body, splats


def _symbols(body: bytes, splats: int, channels: int, levels: int, steps: Steps) -> Symbols:
    """Decode the body of a section; it may be hostile although the checksum is right."""
    rich, evenness = bool(body[0] & RICH), body[0] & ~RICH
    if evenness >= len(EVENNESS):
        raise BadValue("the first byte is unknown")
    model, codes = weights.from_bytes(body[1:], channels, rich)
    coder = Decoder(codes[: len(codes) // 4 * 4])  # a short body is filled up with bytes
    with np.errstate(all="ignore"):  # the weights may be hostile
        cells = code_cells(coder, splats, levels, EVENNESS[evenness])
        cells = cells[np.argsort(hilbert_encode(cells, levels), kind="stable")]
        return GaussianCoder(coder, cells, model).code(channels, steps)


def _exactly(file: BinaryIO, count: int) -> bytes:
    """Read `count` bytes, or raise BadValue."""
    data = file.read(count)
    if len(data) < count:
        raise BadValue("the file is cut off; copy it again")
    return data

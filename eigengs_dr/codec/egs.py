"""The ``.egs`` file format: Gaussians as integers, in sections that are read one by one.

All numbers are little endian. The file starts with a header (`_HEADER`), the background and a
checksum; the header of a set with maps is followed by their table. The sections follow, see
`eigengs_dr.codec.egs_section`.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..gaussian.channels import MAX_CHANNELS as MAX_MAPS
from ..gaussian.channels import TextureMap, channel_weights, check_maps
from ..gaussian.file import CUTOFF, SetData
from ..image.color import MAX_CHANNELS, SPACES
from ..image.hilbert import MAX_LEVELS
from ..storage.atomic import atomic_write
from ..storage.npz import MAX_ENTRIES, BadValue
from .egs_section import decode_body, exactly, read_body, section_to_bytes
from .quantization import Steps, Symbols, dequantize

IntArray = NDArray[np.int64]

SUFFIX = ".egs"

MAGIC = b"\x89EGS"
"""First bytes of a file. The first byte is no ASCII character, so no text file starts with it."""

VERSION, MAPS_VERSION = 3, 4
"""Versions of the format, for a set without maps and with a table of maps. Versions 1
and 2, of packages before release, are not read."""

MAX_SECTIONS = 1 << 12

_HEADER = struct.Struct("<4sBBBBHIIiiffd")
"""Magic, version, space, channels, levels of the square of cells, sections, width, height, column
and row of the first cell, the steps, and the cutoff."""

_CHECK = struct.Struct("<I")

_MAP = struct.Struct("<BBBd")
"""A map in the table, before its name; see `maps_to_bytes`."""


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
        The maps of a set, whose colours and background are multiplied by their weights; empty
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
        """Return the set."""
        arrays = self.arrays()
        if self.maps:
            weights = np.array(channel_weights(self.maps), np.float32)
            arrays |= {name: arrays[name] / weights for name in ("color", "background")}
        return SetData(arrays, self.size, self.space, self.cutoff, self.maps)

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
    parts += [section_to_bytes(part, packed.steps, corner, levels) for part in packed.sections]
    return b"".join(parts)


def write(path: str | os.PathLike[str], packed: EgsContent) -> int:
    """Write a file atomically; return its number of bytes.

    Raises
    ------
    OSError
        If the file cannot be written; an existing file then stays unchanged.
    """
    content = to_bytes(packed)
    with atomic_write(path) as temporary:
        return temporary.write_bytes(content)


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
    return read(path, sections).set_data()


def maps_of(path: str | os.PathLike[str]) -> tuple[TextureMap, ...]:
    """Return the maps of a packed set, without its Gaussians; errors as `read`."""
    path = Path(path)
    with path.open("rb") as file:
        try:
            return _read_header(file)[3].maps
        except BadValue as error:
            raise ValueError(f"{path}: {error}") from None


def section_counts(path: str | os.PathLike[str]) -> list[int]:
    """Return the number of Gaussians of each section, without decoding them; errors as `read`."""
    path = Path(path)
    with path.open("rb") as file:
        try:
            (_, count, *_), size = _read_header(file), os.fstat(file.fileno()).st_size
            return [read_body(file, size, k + 1)[1] for k in range(count)]
        except BadValue as error:
            raise ValueError(f"{path}: {error}") from None


def _read_header(file: BinaryIO) -> tuple[int, int, IntArray, EgsContent]:
    """Return the levels, the number of sections, the first cell, and a content without sections."""
    head = exactly(file, 5)
    if head[:4] != MAGIC:
        raise BadValue("not a packed set of Gaussians; it may be damaged or something else")
    if head[4] not in (VERSION, MAPS_VERSION):
        raise BadValue(
            f"version is {head[4]}, but this package reads versions {VERSION} and {MAPS_VERSION}; "
            + ("upgrade eigengs-dr" if head[4] > VERSION else "pack the set again")
        )
    head += exactly(file, _HEADER.size - len(head))
    _, _, space, channels, levels, count, width, height, *rest = _HEADER.unpack(head)
    background = exactly(file, 4 * channels)
    table = b""
    maps: tuple[TextureMap, ...] = ()
    if head[4] == MAPS_VERSION:
        table, maps = read_maps(partial(exactly, file))
    (check,) = _CHECK.unpack(exactly(file, _CHECK.size))
    if check != zlib.crc32(head + background + table):
        raise BadValue("the header is damaged; copy the file again")
    if maps:
        check_maps(maps, channels)
    corner, steps = np.array(rest[:2], np.int64), Steps(*rest[2:4])
    _check_header(space, channels, levels, count, steps)
    values = np.frombuffer(background, "<f4")
    content = EgsContent([], steps, values, (width, height), SPACES[space], rest[4], maps)
    return levels, count, corner, content


def _read(file: BinaryIO, size: int, wanted: int | None) -> EgsContent:
    levels, count, corner, content = _read_header(file)
    channels = len(content.background)
    if wanted is not None and not 1 <= wanted <= count:
        raise BadValue(f"the file has {count} sections, not {wanted}; ask for 1 to {count}")
    found: list[Symbols] = []
    for number in range(1, (wanted or count) + 1):
        body, splats = read_body(file, size, number)
        room = MAX_ENTRIES // max(3, channels) - sum(len(section.cell) for section in found)
        if splats > room:
            raise BadValue(
                f"section {number} claims {splats} Gaussians, but at most {room} more can be read"
            )
        try:
            symbols = decode_body(body, splats, channels, levels, content.steps)
        except BadValue as error:
            raise BadValue(f"section {number}: {error}; copy the file again") from None
        found.append(symbols._replace(cell=symbols.cell + corner))
    if wanted is None and file.read(1):
        raise BadValue("data follow the last section; copy the file again")
    return content._replace(sections=found)


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


def maps_to_bytes(maps: Sequence[TextureMap]) -> bytes:
    """Return the table of maps; nothing for an image.

    A byte holds the number of maps. Each map has the length of its name, the index of its space,
    its number of channels (a byte each), its weight (float64), and its name in ASCII.
    """
    if not maps:
        return b""
    parts = [bytes([len(maps)])]
    for m in maps:
        name = m.name.encode("ascii")
        parts += [_MAP.pack(len(name), SPACES.index(m.space), m.channels, m.weight), name]
    return b"".join(parts)


def read_maps(take: Callable[[int], bytes]) -> tuple[bytes, tuple[TextureMap, ...]]:
    """Read a table; `take` returns the next bytes, or raises `BadValue`.

    Returns
    -------
    bytes
        The table as it is in the file.
    tuple of TextureMap
        `eigengs_dr.gaussian.channels.check_maps` checks them.
    """
    table, maps = take(1), []
    if not 1 <= table[0] <= MAX_MAPS:
        raise BadValue(f"the header claims {table[0]} maps, expected 1 to {MAX_MAPS}")
    for _ in range(table[0]):
        entry = take(_MAP.size)
        length, space, channels, weight = _MAP.unpack(entry)
        name = take(length)
        if space >= len(SPACES):
            raise BadValue("the header holds unknown values; upgrade eigengs-dr")
        maps.append(TextureMap(name.decode("ascii", "replace"), SPACES[space], channels, weight))
        table += entry + name
    return table, tuple(maps)

"""The ``.egs`` file format: Gaussians as integers, in sections that are read one by one.

All numbers are little endian. The file starts with a header (`_HEADER`), the cutoff from version 2
on, the background and a checksum. The sections follow. A section starts with its number of
Gaussians, its length and its checksum (`_SECTION`). Its planes of integers follow, see
`eigengs_dr.codec.entropy`: steps along a Hilbert curve through the means, s, u, v, and one plane
per channel.
"""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..gaussian.file import CUTOFF, SetData
from ..image.color import MAX_CHANNELS, SPACES
from ..storage.atomic import atomic_write
from ..storage.npz import MAX_ENTRIES, BadValue
from .entropy import decode, encode
from .hilbert_index import MAX_LEVELS, hilbert_decode, hilbert_encode
from .quantization import Steps, Symbols, dequantize

SUFFIX = ".egs"

MAGIC = b"\x89EGS"
"""First bytes of a file. The first byte is no ASCII character, so no text file starts with it."""

VERSION = 2
"""Newest version of the format. Version 2 adds a cutoff after the header; sets with the default
cutoff are written as version 1."""

MAX_SECTIONS = 1 << 12

_HEADER = struct.Struct("<4sBBBBHIIii4f")
"""Magic, version, space, channels, levels of the curve, sections, width, height, corner x and y
(in steps from the centre of the first pixel), and the steps."""

_SECTION = struct.Struct("<III")
"""Number of Gaussians, number of bytes that follow, and their CRC-32."""

_CUTOFF = struct.Struct("<d")

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
    """

    sections: list[Symbols]
    steps: Steps
    background: NDArray[np.float32]
    size: tuple[int, int]
    space: str
    cutoff: float = CUTOFF

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return mean (N, 2), factor (N, 3), color (N, C) and background (C,), all of float32."""
        values = {**dequantize(self.whole(), self.steps), "background": self.background}
        with np.errstate(over="ignore"):
            return {name: value.astype(np.float32) for name, value in values.items()}

    def widths(self) -> dict[str, list[int]]:
        """Return the bits for the range of each parameter: x and y; s, u and v; the colours.

        The codes of a file are shorter, because the values are not uniform.
        """
        return {
            name: [int(span).bit_length() for span in np.ptp(part, axis=0)]
            for name, part in self.whole()._asdict().items()
        }

    def whole(self) -> Symbols:
        """Return the Gaussians of all sections."""
        return Symbols(
            np.concatenate([section.mean for section in self.sections]),
            np.concatenate([section.shape for section in self.sections]),
            np.concatenate([section.color for section in self.sections]),
        )


def is_egs(path: str | os.PathLike[str]) -> bool:
    """Return whether a file starts with `MAGIC`; raise `OSError` if it cannot be opened."""
    with open(path, "rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def to_bytes(packed: EgsContent) -> bytes:
    """Return the bytes of a file; sort the Gaussians of each section in Hilbert-curve order."""
    mean = packed.whole().mean
    corner = mean.min(axis=0)
    levels = int((mean - corner).max()).bit_length()
    head = _HEADER.pack(
        MAGIC,
        1 if packed.cutoff == CUTOFF else VERSION,
        SPACES.index(packed.space),
        len(packed.background),
        levels,
        len(packed.sections),
        *packed.size,
        *corner.tolist(),
        *packed.steps,
    )
    if packed.cutoff != CUTOFF:
        head += _CUTOFF.pack(packed.cutoff)
    head += packed.background.astype("<f4").tobytes()
    parts = [head, _CHECK.pack(zlib.crc32(head))]
    for section in packed.sections:
        body = _body(section, corner, levels)
        parts += [_SECTION.pack(len(section.mean), len(body), zlib.crc32(body)), body]
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
    return SetData(content.arrays(), content.size, content.space, content.cutoff)


def _body(section: Symbols, corner: NDArray[np.int64], levels: int) -> bytes:
    """Return the bytes of the planes of a section."""
    places = hilbert_encode(section.mean - corner, levels)
    # Gaussians at one position are sorted too, so that equal sets in any order give equal files.
    columns = [*section.color.T[::-1], *section.shape.T[::-1], places]
    order = np.lexsort(columns)
    ways = np.diff(places[order], prepend=0)
    planes = [ways, *section.shape[order].T, *section.color[order].T]
    return b"".join(map(encode, planes))


def _read(file: BinaryIO, size: int, wanted: int | None) -> EgsContent:
    head = _exactly(file, _HEADER.size)
    magic, version, space, channels, levels, count, width, height, *rest = _HEADER.unpack(head)
    if magic != MAGIC:
        raise BadValue("not a packed set of Gaussians; it may be damaged or something else")
    if not 1 <= version <= VERSION:
        raise BadValue(
            f"version is {version}, but this package reads up to {VERSION}; upgrade eigengs-dr"
        )
    more = _exactly(file, _CUTOFF.size) if version > 1 else b""
    background = _exactly(file, 4 * channels)
    (check,) = _CHECK.unpack(_exactly(file, _CHECK.size))
    if check != zlib.crc32(head + more + background):
        raise BadValue("the header is damaged; copy the file again")
    corner, steps = np.array(rest[:2], np.int64), Steps(*rest[2:])
    _check_header(space, channels, levels, count, steps)
    if wanted is not None and not 1 <= wanted <= count:
        raise BadValue(f"the file has {count} sections, not {wanted}; ask for 1 to {count}")
    found: list[Symbols] = []
    for number in range(1, (wanted or count) + 1):
        body, splats = _section(file, size, number, 4 + channels)
        room = MAX_ENTRIES // max(3, channels) - sum(len(section.mean) for section in found)
        if splats > room:
            raise BadValue(
                f"section {number} claims {splats} Gaussians, but at most {room} more can be read"
            )
        try:
            found.append(_symbols(body, splats, channels, corner, levels))
        except BadValue as error:
            raise BadValue(f"section {number}: {error}; copy the file again") from None
    if wanted is None and file.read(1):
        raise BadValue("data follow the last section; copy the file again")
    return EgsContent(
        sections=found,
        steps=steps,
        background=np.frombuffer(background, "<f4"),
        size=(width, height),
        space=SPACES[space],
        cutoff=_CUTOFF.unpack(more)[0] if more else CUTOFF,
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


def _section(file: BinaryIO, size: int, number: int, planes: int) -> tuple[bytes, int]:
    """Read the next section, check its checksum, and return its planes and number of Gaussians."""
    splats, length, check = _SECTION.unpack(_exactly(file, _SECTION.size))
    if length > size - file.tell():
        raise BadValue(f"section {number} is cut off; copy the file again")
    # Every integer takes at least one bit, so the length of the file bounds the memory.
    if not 1 <= splats <= 8 * length // planes:
        raise BadValue(
            f"section {number} claims {splats} Gaussians in {length} bytes; copy the file again"
        )
    body = _exactly(file, length)
    if zlib.crc32(body) != check:
        raise BadValue(f"section {number} is damaged; copy the file again")
    return body, splats


def _symbols(
    body: bytes, splats: int, channels: int, corner: NDArray[np.int64], levels: int
) -> Symbols:
    """Decode the planes of a section; they may be hostile although the checksum is right."""
    planes, rest = list[NDArray[np.int64]](), memoryview(body)
    for _ in range(4 + channels):
        plane, rest = decode(rest, splats)
        planes.append(plane)
    if len(rest):
        raise BadValue("data follow the last plane")
    ways, places = planes[0], np.cumsum(planes[0])
    if (ways < 0).any() or (places < 0).any() or places[-1] >> 2 * levels:
        raise BadValue("the curve leaves its square")
    return Symbols(
        hilbert_decode(places, levels) + corner,
        np.stack(planes[1:4], axis=1),
        np.stack(planes[4:], axis=1),
    )


def _exactly(file: BinaryIO, count: int) -> bytes:
    """Read `count` bytes, or raise BadValue."""
    data = file.read(count)
    if len(data) < count:
        raise BadValue("the file is cut off; copy it again")
    return data

"""Pictures that Pillow reads: files, and `PIL.Image.Image` objects."""

from __future__ import annotations

import re
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, TypeGuard

import numpy as np

from .header import ORIENTATION, TURNED, Header, frames_note, profile_note
from .pixels import ImageError
from .strips import Pixels

if TYPE_CHECKING:
    from PIL.Image import Image

GREY = ("1", "L", "LA", "La", "I", "I;16", "I;16B", "I;16L", "F")
"""Modes of Pillow of one channel and perhaps alpha."""

OPAQUE_BYTES, TRANSPARENT_BYTES = {1: 4, 3: 10}, {1: 12, 3: 17}
"""Bytes a pixel while a picture is decoded, by its channels, as measured with 36 to 44 megapixels:
Pillow keeps colours in 4, and a copy to NumPy takes the 3 that stay, twice. Transparent ones become
floats."""

SRGB_GAMMA = 45_455
"""Chunk gAMA of a PNG file of sRGB: 100,000 / 2.2."""

TRANSFERS = {8: "linear light", 14: "Rec. 2020", 15: "Rec. 2020", 16: "PQ", 18: "HLG"}
"""Transfer functions of ITU-T H.273 that are far from sRGB."""

PRIMARIES = {9: "Rec. 2020", 11: "P3", 12: "P3"}
"""Primaries of ITU-T H.273 of wider gamuts."""


@contextmanager
def open_picture(path: Path) -> Iterator[Image]:
    """Open what `PIL.Image.open` opens, of any size, and close it; nothing is decoded yet.

    Pillow's limit on pixels is a variable of the whole process, which threads share;
    `Header.check_memory` bounds what is decoded here.

    Raises
    ------
    PIL.UnidentifiedImageError
        If Pillow does not know the file.
    """
    from PIL import Image, UnidentifiedImageError

    Image.init()
    with path.open("rb") as file:
        prefix = file.read(16)
        for name in Image.ID:
            factory, accepts = Image.OPEN[name]
            known = accepts is None or accepts(prefix)
            if known and not isinstance(known, str):
                file.seek(0)
                try:
                    image = factory(file, str(path))
                except (SyntaxError, IndexError, TypeError, struct.error):  # as Image.open
                    continue
                yield image
                return
    raise UnidentifiedImageError(f"cannot identify image file {path}")


def picture_header(path: Path) -> Header:
    """Return what the header of a file says that `picture_pixels_of` reads."""
    with open_picture(path) as image:
        transparent = image.has_transparency_data
        channels = 1 if image.mode in GREY else 3
        notes = profile_note(image.info.get("icc_profile") or b"", "srgb")
        if image.format == "PNG":
            chunks = png_chunks(path)
            orientation = exif_orientation(chunks.get(b"eXIf", b""))
            notes += _png_notes(chunks)
        else:
            orientation = image.getexif().get(ORIENTATION, 1)
            notes += _depth_notes(path, image.format)
        notes += frames_note(getattr(image, "n_frames", 1))
        width, height = image.size[::-1] if orientation in TURNED else image.size
    needed = TRANSPARENT_BYTES[channels] if transparent else OPAQUE_BYTES[channels]
    alpha = "straight" if transparent else "none"
    return Header(width, height, channels, needed, alpha=alpha, notes=notes)


def read_picture(path: Path) -> Pixels:
    """Return the pixels of a file, turned as its EXIF header says; see `picture_pixels`."""
    from PIL import ImageOps

    with open_picture(path) as image:
        ImageOps.exif_transpose(image, in_place=True)  # a copy only if it turns the image
        return picture_pixels(image)


def picture_pixels(image: Image) -> Pixels:
    """Return the pixels of a Pillow image by its mode.

    Parameters
    ----------
    image : PIL.Image.Image

    Returns
    -------
    ndarray, shape (H, W, C)
        Grey or RGB; with alpha as the last of 2 or 4 channels if `image.has_transparency_data`.

    Raises
    ------
    ImageError
        If the mode has no one meaning as a picture.
    """
    mode = image.mode
    if mode == "I" and image.format != "PNG":
        raise ImageError("holds integers of 32 bits, whose white nobody knows; convert it to I;16")
    if mode == "LAB":
        raise ImageError("holds CIELab colours; convert it to RGB")
    if mode == "I":  # a PNG file of 16 bits, before Pillow 11
        return np.asarray(image).astype(np.uint16)[..., None]
    if mode == "F" or mode.startswith("I;16"):
        values = np.asarray(image)[..., None]
        if not image.has_transparency_data:
            return values
        alpha = np.where(values == image.info["transparency"], 0, 65535).astype(np.uint16)
        return np.concatenate([values.astype(np.uint16), alpha], axis=2)
    if image.has_transparency_data:
        kind = "LA" if mode in GREY else "RGBA"
        if mode == "La":
            image = image.convert("LA")
        return np.asarray(image if image.mode == kind else image.convert(kind))
    # `convert` copies the image even if the mode stays.
    pixels = np.asarray(image if mode in ("1", "L", "RGB") else image.convert("RGB"))
    return pixels if pixels.ndim == 3 else pixels[..., None]


def is_picture(image: object) -> TypeGuard[Image]:
    """Whether an image is a `PIL.Image.Image`; does not import Pillow."""
    return "PIL.Image" in sys.modules and isinstance(image, sys.modules["PIL.Image"].Image)


# ---------------------------------------------------------------------------------------------
#  What Pillow does not say
# ---------------------------------------------------------------------------------------------


def png_chunks(path: Path) -> dict[bytes, bytes]:
    """Return the chunks of a PNG file by their names, without those of pixels."""
    chunks: dict[bytes, bytes] = {}
    with path.open("rb") as file:
        file.seek(8)
        while len(head := file.read(8)) == 8:
            length, name = struct.unpack(">I4s", head)
            if name in (b"IDAT", b"fdAT") or length > 1 << 16:
                file.seek(length + 4, 1)
            else:
                chunks.setdefault(name, file.read(length))
                file.seek(4, 1)
    return chunks


def exif_orientation(exif: bytes) -> int:
    """Return the orientation of EXIF data, 1 if they name none or are damaged."""
    from PIL import Image

    data = Image.Exif()
    with suppress(SyntaxError, struct.error, ValueError, TypeError, KeyError):
        data.load(exif)
    orientation = data.get(ORIENTATION, 1)
    return orientation if orientation in range(1, 9) else 1


def _png_notes(chunks: dict[bytes, bytes]) -> tuple[str, ...]:
    """Return warnings for colours that are not sRGB, by the chunk that counts most."""
    if len(code := chunks.get(b"cICP", b"")) == 4:
        return video_note(*code[:2])
    if b"iCCP" in chunks or b"sRGB" in chunks or len(chunks.get(b"gAMA", b"")) != 4:
        return ()
    [gamma] = struct.unpack(">I", chunks[b"gAMA"])
    if gamma and abs(gamma / SRGB_GAMMA - 1) < 0.05:
        return ()
    return (f"its gamma of {gamma / 100_000:g} is not that of sRGB, and is ignored",)


def video_note(primaries: int, transfer: int) -> tuple[str, ...]:
    """Return a warning for codes of ITU-T H.273 that are not those of sRGB."""
    names = {PRIMARIES.get(primaries, ""), TRANSFERS.get(transfer, "")} - {""}
    if not names:
        return ()
    return (f"its colours are {' and '.join(sorted(names))}, not sRGB, which is ignored",)


_PIXI = re.compile(rb"pixi\0\0\0\0.(.)", re.S)
_NCLX = re.compile(rb"colrnclx(..)(..)", re.S)
_SIZ = re.compile(rb"\xff\x4f\xff\x51.{38}(.)", re.S)


def _depth_notes(path: Path, kind: str | None) -> tuple[str, ...]:
    """Return warnings for what AVIF and JPEG 2000 files hold and Pillow leaves out."""
    if kind not in ("AVIF", "JPEG2000"):
        return ()
    with path.open("rb") as file:
        start = file.read(1 << 14)
    notes: tuple[str, ...] = ()
    if kind == "AVIF":
        bits = max((match[1][0] for match in _PIXI.finditer(start)), default=8)
        if match := _NCLX.search(start):
            notes = video_note(*(int.from_bytes(code, "big") for code in match.groups()))
    else:
        match = _SIZ.search(start)
        bits = (match[1][0] & 127) + 1 if match else 8
        grey = match is not None and match[0][-3:-1] == b"\0\1"
        bits = 8 if grey and bits <= 16 else bits  # all of which Pillow keeps
    return (*notes, f"keeps 8 of its {bits} bits") if bits > 8 else notes

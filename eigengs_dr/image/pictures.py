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

from .formats import HAS_HEIF
from .header import ORIENTATION, TRANSPOSED, Header, frames_note, profile_note
from .pixels import ImageError
from .strips import Pixels

if TYPE_CHECKING:
    from PIL.Image import Image

GREY_MODES = ("1", "L", "LA", "La", "I", "I;16", "I;16B", "I;16L", "F")
"""Pillow modes with one channel and optionally alpha."""

OPAQUE_BYTES, TRANSPARENT_BYTES = {1: 4, 3: 10}, {1: 12, 3: 17}
"""Bytes per pixel while a picture is decoded, by number of channels, measured with 36 to 44
megapixels: Pillow stores colours in 4 bytes, and the copy to NumPy temporarily takes 3 bytes twice.
Transparent pictures are converted to floats."""

SRGB_GAMMA = 45_455
"""Value of the gAMA chunk of an sRGB PNG file: 100,000 / 2.2."""

TRANSFERS = {8: "linear light", 14: "Rec. 2020", 15: "Rec. 2020", 16: "PQ", 18: "HLG"}
"""Transfer functions of ITU-T H.273 that differ much from sRGB."""

PRIMARIES = {9: "Rec. 2020", 11: "P3", 12: "P3"}
"""Primaries of ITU-T H.273 with wider gamuts."""


@contextmanager
def open_picture(path: Path) -> Iterator[Image]:
    """Open a file as `PIL.Image.open` does but of any size; nothing is decoded yet.

    Pillow's limit on pixels is a process-wide variable, which threads share; `Header.check_memory`
    limits what is decoded here.

    Raises
    ------
    PIL.UnidentifiedImageError
        If Pillow does not know the file.
    """
    from PIL import Image, UnidentifiedImageError

    Image.init()
    with path.open("rb") as file:
        prefix = file.read(16)
        if HAS_HEIF and prefix[4:8] == b"ftyp":
            from pillow_heif import register_heif_opener

            register_heif_opener()
        for name in Image.ID:
            factory, accepts = Image.OPEN[name]
            try:
                known = accepts is None or accepts(prefix)  # of short files it raises struct.error
                if not known or isinstance(known, str):
                    continue
                file.seek(0)
                image = factory(file, str(path))
            except (SyntaxError, IndexError, TypeError, struct.error):  # as Image.open
                continue
            yield image
            return
    raise UnidentifiedImageError(f"cannot identify image file {path}")


def picture_header(path: Path) -> Header:
    """Return the header of a file that `read_picture` reads."""
    with open_picture(path) as image:
        transparent = image.has_transparency_data
        channels = 1 if image.mode in GREY_MODES else 3
        notes = profile_note(image.info.get("icc_profile") or b"", "srgb")
        if image.format == "PNG":
            chunks = png_chunks(path)
            orientation = exif_orientation(chunks.get(b"eXIf", b""))
            notes += _png_notes(chunks)
        else:
            orientation = image.getexif().get(ORIENTATION, 1)
            notes += _depth_notes(path, image)
        notes += frames_note(getattr(image, "n_frames", 1))
        width, height = image.size[::-1] if orientation in TRANSPOSED else image.size
    needed = TRANSPARENT_BYTES[channels] if transparent else OPAQUE_BYTES[channels]
    alpha = "straight" if transparent else "none"
    return Header(width, height, channels, needed, alpha=alpha, notes=notes)


def read_picture(path: Path) -> Pixels:
    """Return the pixels of a file with its EXIF orientation applied; see `picture_pixels`."""
    from PIL import ImageOps

    with open_picture(path) as image:
        ImageOps.exif_transpose(image, in_place=True)  # copies only if the image is turned
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
        If the mode is ambiguous or not supported.
    """
    mode = image.mode
    if mode == "I" and image.format != "PNG":
        raise ImageError("holds 32-bit integers, whose white is unknown; convert it to I;16")
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
        kind = "LA" if mode in GREY_MODES else "RGBA"
        if mode == "La":
            image = image.convert("LA")
        return np.asarray(image if image.mode == kind else image.convert(kind))
    # `convert` copies the image even if the mode is the same.
    pixels = np.asarray(image if mode in ("1", "L", "RGB") else image.convert("RGB"))
    return pixels if pixels.ndim == 3 else pixels[..., None]


def is_picture(image: object) -> TypeGuard[Image]:
    """Return whether an image is a `PIL.Image.Image`, without importing Pillow."""
    return "PIL.Image" in sys.modules and isinstance(image, sys.modules["PIL.Image"].Image)


# ---------------------------------------------------------------------------------------------
#  Metadata that Pillow does not provide
# ---------------------------------------------------------------------------------------------


def png_chunks(path: Path) -> dict[bytes, bytes]:
    """Return the chunks of a PNG file by name, except those with pixels."""
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
    """Return the orientation in EXIF data, 1 if there is none or the data is damaged."""
    from PIL import Image

    data = Image.Exif()
    with suppress(SyntaxError, struct.error, ValueError, TypeError, KeyError):
        data.load(exif)
    orientation = data.get(ORIENTATION, 1)
    return orientation if orientation in range(1, 9) else 1


def _png_notes(chunks: dict[bytes, bytes]) -> tuple[str, ...]:
    """Return warnings about colours that are not sRGB, by the chunk of highest priority."""
    if len(code := chunks.get(b"cICP", b"")) == 4:
        return video_note(*code[:2])
    if b"iCCP" in chunks or b"sRGB" in chunks or len(chunks.get(b"gAMA", b"")) != 4:
        return ()
    [gamma] = struct.unpack(">I", chunks[b"gAMA"])
    if gamma and abs(gamma / SRGB_GAMMA - 1) < 0.05:
        return ()
    return (f"its gamma of {gamma / 100_000:g} is not that of sRGB, and is ignored",)


def video_note(primaries: int, transfer: int) -> tuple[str, ...]:
    """Return a warning about codes of ITU-T H.273 that are not those of sRGB."""
    names = {PRIMARIES.get(primaries, ""), TRANSFERS.get(transfer, "")} - {""}
    if not names:
        return ()
    return (f"its colours are {' and '.join(sorted(names))}, not sRGB, which is ignored",)


_PIXI = re.compile(rb"pixi\0\0\0\0.(.)", re.S)
_NCLX = re.compile(rb"colrnclx(..)(..)", re.S)
_SIZ = re.compile(rb"\xff\x4f\xff\x51.{38}(.)", re.S)


def _depth_notes(path: Path, image: Image) -> tuple[str, ...]:
    """Return warnings about properties of AVIF, HEIF and JPEG 2000 files that Pillow ignores."""
    kind, notes = image.format, tuple[str, ...]()
    if kind not in ("AVIF", "HEIF", "JPEG2000"):
        return ()
    with path.open("rb") as file:
        start = file.read(1 << 14)
    if kind == "HEIF":
        bits, color = image.info.get("bit_depth", 8), image.info.get("nclx_profile") or {}
        names = ("color_primaries", "transfer_characteristics")
        notes = video_note(*(color.get(name, 1) for name in names))
    elif kind == "AVIF":
        bits = max((match[1][0] for match in _PIXI.finditer(start)), default=8)
        if match := _NCLX.search(start):
            notes = video_note(*(int.from_bytes(code, "big") for code in match.groups()))
    else:
        match = _SIZ.search(start)
        bits = (match[1][0] & 127) + 1 if match else 8
        grey = match is not None and match[0][-3:-1] == b"\0\1"
        bits = 8 if grey and bits <= 16 else bits  # Pillow keeps all bits of these
    return (*notes, f"keeps 8 of its {bits} bits") if bits > 8 else notes

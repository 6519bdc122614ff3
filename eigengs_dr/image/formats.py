"""The formats of image files: who reads them, their suffixes, and how they are written."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from ..backend.types import Record
from .pixels import Pixels

STARTS = {
    b"II*\0": "tiff",
    b"MM\0*": "tiff",
    b"II+\0": "tiff",
    b"MM\0+": "tiff",
    b"\x76\x2f\x31\x01": "openexr",
    b"#?": "hdr",
    b"\x89PNG\r\n\x1a\n": "png",
    b"\xff\xd8\xff": "jpeg",
    **{b"P%c" % kind: "pnm" for kind in b"123456Ff"},
}
"""First bytes of the files that OpenImageIO reads, with its names of the formats; Pillow reads all
others. OpenImageIO 3.2 decodes JPEG 2000 before its size can be checked, takes the unused byte of a
BMP file for alpha, and tells neither the frames of WebP nor whether a GIF is grey."""

BITS: dict[str, tuple[int, ...]] = {
    ".png": (8, 16),
    ".jpg": (8,),
    ".jpeg": (8,),
    ".webp": (8,),
    ".tif": (8, 16, 32),
    ".tiff": (8, 16, 32),
    ".bmp": (8,),
    ".ppm": (8,),
    ".exr": (32, 16),
    ".hdr": (32,),
    ".pfm": (32,),
}
"""Suffixes of files that can be written, with the possible bits per value; the first number is the
default. 32 bits are floats, and so are 16 in an EXR file. An HDR file stores 8 bits per value and a
shared exponent."""

SUFFIXES = tuple(BITS)
"""Suffixes of files that can be written."""

HEIF_SUFFIXES = (".heic", ".heif", ".hif")
"""Suffixes of files that Pillow reads with the package pillow-heif."""

HAS_HEIF = find_spec("pillow_heif") is not None

READ_SUFFIXES = (
    *SUFFIXES,
    *(HEIF_SUFFIXES if HAS_HEIF else ()),
    *(".jfif", ".jpe", ".apng", ".avif", ".gif", ".tga", ".dib"),
    *(".jp2", ".j2k", ".jpf", ".jpx", ".pgm", ".pbm", ".pnm"),
)
"""Suffixes of files that are read from a folder. A single file is read by its content."""

UNREAD_SUFFIXES = (
    *(() if HAS_HEIF else HEIF_SUFFIXES),
    *(".jxl", ".jpc", ".svg", ".psd", ".psb", ".xcf", ".kra", ".eps", ".ico"),
    *(".dds", ".ktx", ".ktx2", ".rgbe", ".sgi", ".pcx", ".dng", ".cr2", ".cr3", ".nef"),
    *(".arw", ".raf", ".orf", ".rw2", ".pef", ".srw", ".fits", ".fit", ".dcm", ".npy", ".pam"),
)
"""Suffixes of images that cannot be read; a warning names those in a folder."""

PICTURE_SUFFIXES = tuple(suffix for suffix, bits in BITS.items() if 8 in bits)
"""Suffixes of 8-bit files, which Pillow writes; OpenImageIO writes the others."""

TIFF_SUFFIXES = (".tif", ".tiff")

LOSSY = (".jpg", ".jpeg", ".webp")

MAX_HALF = 65_504.0
"""Largest finite 16-bit float."""


def write_file(path: Path, pixels: Pixels, bits: int) -> None:
    """Write pixels (H, W, C): float32, uint16 for 16-bit PNG and TIFF files, or uint8.

    Raises
    ------
    ValueError, OSError
        If the file cannot be written.
    """
    suffix = path.suffix.lower()
    if bits == 8 or (suffix == ".png" and pixels.shape[2] == 1):
        from PIL import Image

        options: Record = {"quality": 95} if suffix in LOSSY else {}
        flat = pixels[..., 0] if pixels.shape[2] == 1 else pixels
        Image.fromarray(flat).save(path, **options)
    else:
        _write_openimageio(path, pixels, bits)
    check_room(path)


def _write_openimageio(path: Path, pixels: Pixels, bits: int) -> None:
    """Write floats, a 16-bit PNG or a 16-bit TIFF; 16-bit floats are clamped to +-65,504."""
    import OpenImageIO as oiio

    suffix = path.suffix.lower()
    if suffix == ".hdr":  # always has three channels
        pixels = np.broadcast_to(pixels, (*pixels.shape[:2], 3))
    kind = "uint16" if pixels.dtype == np.uint16 else ("half" if bits == 16 else "float")
    if kind == "half":
        pixels = np.clip(pixels, -MAX_HALF, MAX_HALF)
    image = oiio.ImageBuf(np.ascontiguousarray(pixels))
    image.set_write_format(kind)
    image.specmod().channelnames = ("R", "G", "B") if pixels.shape[2] == 3 else ("Y",)
    image.specmod().attribute("compression", "zip")
    if not image.write(str(path)):
        raise_reason(path, image.geterror().strip())


def raise_reason(path: Path, reason: str) -> None:
    """Raise the error of the system for a file that OpenImageIO could not write, or its own."""
    check_room(path)
    raise OSError(reason)


def check_room(path: Path) -> None:
    """Raise the error of the system if a file, as it was written, cannot grow by a block.

    Pillow and OpenImageIO take a picture that a full disk has cut for written.
    """
    size = path.stat().st_size
    with path.open("ab") as file:
        file.write(bytes(1 << 12))
        file.truncate(size)

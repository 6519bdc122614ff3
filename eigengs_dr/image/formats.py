"""Suffixes of image files, and the libraries that write them: Pillow, tifffile, OpenImageIO.

OpenImageIO, from the extra ``hdr``, writes EXR, Radiance HDR and PNG files of 16-bit colour.
"""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from ..backend.types import Record
from .strips import Pixels

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
"""Suffixes of 8-bit files, which Pillow writes."""

TIFF_SUFFIXES = (".tif", ".tiff")

LOSSY = (".jpg", ".jpeg", ".webp")

ADVICE = "needs OpenImageIO; type: pip install 'eigengs-dr[hdr]'"

MAX_HALF = 65_504.0
"""Largest finite 16-bit float."""


def write_file(path: Path, pixels: Pixels, bits: int) -> None:
    """Write pixels (H, W, C): float32, uint16 for 16-bit PNG and TIFF files, or uint8.

    Raises
    ------
    ImportError, ValueError, OSError
        If a package is missing, or the file cannot be written.
    """
    suffix = path.suffix.lower()
    grey = pixels.shape[2] == 1
    flat = pixels[..., 0] if grey else pixels
    if bits == 8 or (suffix == ".png" and grey):
        from PIL import Image

        options: Record = {"quality": 95} if suffix in LOSSY else {}
        Image.fromarray(flat).save(path, **options)
    elif suffix in TIFF_SUFFIXES:
        import tifffile

        kind = "minisblack" if grey else "rgb"
        tifffile.imwrite(path, flat, photometric=kind, compression="zlib")
    elif suffix == ".pfm":
        header = f"{'Pf' if grey else 'PF'}\n{pixels.shape[1]} {pixels.shape[0]}\n-1.0\n"
        path.write_bytes(header.encode() + pixels[::-1].astype("<f4").tobytes())
    else:
        _write_openimageio(path, pixels, bits)


def has_openimageio() -> bool:
    """Return whether OpenImageIO is installed."""
    return find_spec("OpenImageIO") is not None


def _write_openimageio(path: Path, pixels: Pixels, bits: int) -> None:
    """Write an EXR or HDR file, or a 16-bit PNG; 16-bit floats are clamped to +-65,504."""
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
    if suffix == ".exr":
        image.specmod().attribute("compression", "zip")
    written = image.write(str(path))
    reason = image.geterror().strip() or "the file is cut"
    if written and suffix == ".png":  # OpenImageIO takes one that a full disk has cut for written
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - len(PNG_END)))
            written = file.read() == PNG_END
    if not written:
        with path.open("ab") as file:  # nor does it tell why; the system does
            file.write(bytes(1 << 16))
            os.fsync(file.fileno())
        raise OSError(reason)


PNG_END = b"IEND\xaeB`\x82"
"""Last bytes of a PNG file."""

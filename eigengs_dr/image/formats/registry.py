"""Which function reads and writes a file that Pillow does not keep."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

from . import openimageio, pfm, tiff

FLOAT_SUFFIXES = (".exr", ".hdr", ".pfm")
"""Suffixes of files that hold floats, whatever is written."""

TIFF_SUFFIXES = (".tif", ".tiff")

BITS: dict[str, tuple[int, ...]] = {
    ".exr": (32, 16),
    ".hdr": (32,),
    ".pfm": (32,),
    ".png": (8, 16),
    ".tif": (8, 16, 32),
    ".tiff": (8, 16, 32),
}
"""Bits of a value that a file may have, by its suffix; the first is the default. 32 are floats, and
so are 16 in an EXR file. An HDR file stores 8 bits of a value and an exponent."""

_TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

_PNG_START = b"\x89PNG\r\n\x1a\n"

_DEEP_PNG = (2, 4, 6)
"""Colour types of PNG of which Pillow keeps 8 bits only: RGB, grey with alpha, RGBA."""


class DeepPixels(NamedTuple):
    """What a file holds.

    Attributes
    ----------
    pixels : ndarray of uint16 or floats, shape (H, W, C)
    orientation : int
        As in EXIF; 1 is upright.
    associated : bool
        Whether colours are multiplied by alpha already.
    one_channel : bool
        Whether the file is an EXR file of a single channel, which may be anything.
    """

    pixels: NDArray[Any]
    orientation: int = 1
    associated: bool = False
    one_channel: bool = False


def kind_of(path: Path) -> str | None:
    """Return "exr", "hdr", "pfm", "tiff" or "png" by the first bytes of a file.

    Returns None for files that Pillow reads without loss; a file of the kind "tiff" may be one.

    Raises
    ------
    OSError
        If the file cannot be opened.
    """
    with path.open("rb") as file:
        start = file.read(32)
    if start[:4] == b"\x76\x2f\x31\x01":
        return "exr"
    if start[:2] == b"#?":
        return "hdr"
    if start[:2] in (b"PF", b"Pf") and start[2:3].isspace():
        return "pfm"
    if start[:4] in _TIFF_STARTS:
        return "tiff"
    if start[:8] == _PNG_START and start[24:25] == b"\x10" and start[25] in _DEEP_PNG:
        return "png"
    return None


def read_deep(path: Path) -> DeepPixels | None:
    """Read a file without loss, if Pillow would lose some of it.

    Raises
    ------
    ValueError
        If the file is damaged or holds more than one image of RGB, or a package is missing.
    OSError
        If the file cannot be opened.
    """
    readers: dict[str | None, Callable[[Path], DeepPixels | None]] = {
        "exr": _read_exr,
        "hdr": lambda path: DeepPixels(openimageio.read(path, integers=False)),
        "pfm": lambda path: DeepPixels(pfm.read(path)),
        "png": lambda path: DeepPixels(openimageio.read(path, integers=True)),
        "tiff": _read_tiff,
    }
    reader = readers.get(kind_of(path))
    return reader(path) if reader else None


def _read_exr(path: Path) -> DeepPixels:
    pixels = openimageio.read_exr(path)
    return DeepPixels(pixels, associated=True, one_channel=pixels.shape[2] == 1)


def _read_tiff(path: Path) -> DeepPixels | None:
    found = tiff.read(path)
    return found and DeepPixels(*found)


def write_deep(path: Path, pixels: NDArray[Any], bits: int) -> None:
    """Write pixels (H, W, C): float32, or uint16 for PNG and TIFF files of 16 bits.

    Raises
    ------
    ValueError, OSError
        If a package is missing, or the file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix in TIFF_SUFFIXES:
        tiff.write(path, pixels)
    elif suffix == ".pfm":
        pfm.write(path, pixels)
    elif suffix == ".png" and pixels.shape[2] == 1:
        from PIL import Image

        Image.fromarray(pixels[..., 0]).save(path)
    else:
        openimageio.write(path, pixels, bits)


def turn(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Turn pixels (H, W, C) upright, by the orientation of EXIF."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels

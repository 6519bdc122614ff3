"""Which function reads and writes a file: Pillow, tifffile for TIFF of more bits, OpenImageIO.

Pillow keeps 8 bits of TIFF files and reads no floats. A portable float map has a header of three
lines, then rows of float32 from bottom to top; OpenImageIO 3.2 returns them upside down.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import openimageio
from .pixels import ImageError
from .strips import map_threads, strips

if TYPE_CHECKING:
    from PIL.Image import Image


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
        "pfm": lambda path: DeepPixels(read_pfm(path)),
        "png": lambda path: DeepPixels(openimageio.read(path, integers=True)),
        "tiff": lambda path: (found := read_tiff(path)) and DeepPixels(*found),
    }
    reader = readers.get(kind_of(path))
    return reader(path) if reader else None


def _read_exr(path: Path) -> DeepPixels:
    pixels = openimageio.read_exr(path)
    return DeepPixels(pixels, associated=True, one_channel=pixels.shape[2] == 1)


def write_deep(path: Path, pixels: NDArray[Any], bits: int) -> None:
    """Write pixels (H, W, C): float32, or uint16 for PNG and TIFF files of 16 bits.

    Raises
    ------
    ValueError, OSError
        If a package is missing, or the file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix in TIFF_SUFFIXES:
        write_tiff(path, pixels)
    elif suffix == ".pfm":
        write_pfm(path, pixels)
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


SAVE_OPTIONS: dict[str, dict[str, Any]] = {
    ".png": {},
    ".jpg": {"quality": 95},
    ".jpeg": {"quality": 95},
    ".webp": {"quality": 95},
    ".tif": {},
    ".tiff": {},
    ".bmp": {},
    ".ppm": {},
}
"""Suffixes of files that Pillow writes, with the options that it receives."""


@contextmanager
def open_picture(path: Path, most: int | None = None) -> Iterator[Image]:
    """Open an image file with Pillow, turned as its EXIF header says; errors as `load_image`.

    With `most`, the sides have at most so many pixels, which the header says before anything is
    decoded, and Pillow's own limit, of the whole process, does not count.
    """
    from PIL import Image, ImageOps  # 0.05 s

    with image_errors(path), Image.open(path) if most is None else open_header(path) as file:
        if most is not None and max(file.size) > most:
            width, height = file.size
            raise ImageError(f"{path}: {width}x{height} pixels; sides go from 1 to {most:,}")
        ImageOps.exif_transpose(file, in_place=True)  # a copy only if it turns the image
        yield file


def open_header(path: Path) -> Any:
    """Return what `PIL.Image.open` returns, of any size: nothing is decoded yet.

    Pillow's limit on pixels is a variable of the whole process, which threads share.

    Raises
    ------
    PIL.UnidentifiedImageError
        If Pillow does not know the file.
    """
    from PIL import Image, UnidentifiedImageError

    Image.init()
    file = path.open("rb")
    prefix = file.read(16)
    for name in Image.ID:
        factory, accepts = Image.OPEN[name]
        known = accepts is None or accepts(prefix)
        if known and not isinstance(known, str):
            file.seek(0)
            with suppress(SyntaxError, IndexError, TypeError, struct.error):  # as Image.open
                return factory(file, str(path))
    file.close()
    raise UnidentifiedImageError(f"cannot identify image file {path}")


@contextmanager
def image_errors(path: Path) -> Iterator[None]:
    """Turn the errors of a block that reads a file into errors of `load_image`."""
    from PIL import Image, UnidentifiedImageError

    try:
        if path.stat().st_size == 0:
            raise ImageError(f"{path}: the file is empty (0 bytes); copy or export it again")
        yield
    except ImageError:
        raise
    except FileNotFoundError:
        raise ImageError(f"{path}: no such file; check the path") from None
    except IsADirectoryError:
        raise ImageError(f"{path}: is a folder; name an image file in it") from None
    except PermissionError:
        raise ImageError(f"{path}: may not be read; check its permissions") from None
    except UnidentifiedImageError:
        raise ImageError(
            f"{path}: not an image that Pillow knows; save it as PNG or JPEG"
        ) from None
    except Image.DecompressionBombError:
        limit = f"{2 * (Image.MAX_IMAGE_PIXELS or 0):,}"
        raise ImageError(
            f"{path}: has more than {limit} pixels; scale it down first, or fit it in blocks"
        ) from None
    except Exception as error:  # on damaged files Pillow's decoders raise many types
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ImageError(f"{path}: damaged or unsupported ({reason}); export it again") from error


def picture_pixels(image: Image) -> tuple[NDArray[Any], bool]:
    """Return the pixels of a Pillow image, and whether some of them are transparent."""
    if image.mode == "I":  # 16-bit grey of PGM files comes as 32-bit integers
        return np.asarray(image) / 65535, False
    if image.mode == "F" or image.mode.startswith("I;16"):
        return np.asarray(image), False
    if not image.has_transparency_data:
        # `convert` copies the image even if the mode stays.
        return np.asarray(image if image.mode in ("1", "L", "RGB") else image.convert("RGB")), False
    pixels = np.asarray(image.convert("RGBA"))
    shown = np.empty((*pixels.shape[:2], 3), np.float32)

    def show_over_white(rows: slice) -> None:
        part = pixels[rows].astype(np.float32) / 255
        color, alpha = part[..., :3], part[..., 3:]
        shown[rows] = 1 - alpha * (1 - color)

    map_threads(show_over_white, strips(*shown.shape[:2]))
    return shown, bool(pixels[..., 3].min() < 255)


DEEP = ("u2", "f2", "f4", "f8")
"""Types of values that this module reads."""

MAX_PIXELS = 1 << 29
"""Largest number of pixels, as of other files; a damaged header may claim more than fits."""

PLAIN = (1, 2)
"""Photometric interpretations: black is zero, and RGB."""


def read_tiff(path: Path) -> tuple[NDArray[Any], int] | None:
    """Read the first image of a file, if it holds more than 8 bits.

    Returns
    -------
    pixels : ndarray of uint16 or floats, shape (H, W, C)
    orientation : int
        The tag of this name, as in EXIF: 1 is upright.
        None, instead of both, for a file that Pillow reads as well.

    Raises
    ------
    ValueError
        If the file is damaged, or its compression is unknown to tifffile.
    """
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            page = file.pages[0]
            known = page.dtype is not None and page.dtype.str[1:] in DEEP
            if not known or page.photometric not in PLAIN or page.samplesperpixel > 4:
                return None
            if page.imagewidth * page.imagelength > MAX_PIXELS:
                raise ValueError(f"more than {MAX_PIXELS:,} pixels")
            pixels = page.asarray()
            turned = page.tags["Orientation"].value if "Orientation" in page.tags else 1
            if pixels.ndim == 3 and page.planarconfig == 2:
                pixels = np.moveaxis(pixels, 0, 2)
    except Exception as error:  # tifffile raises many types
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"damaged or unsupported ({reason}); export it again") from error
    return pixels if pixels.ndim == 3 else pixels[..., None], int(turned)


def write_tiff(path: Path, pixels: NDArray[Any]) -> None:
    """Write uint16 or float32 (H, W, 3) or (H, W, 1) without loss."""
    import tifffile

    grey = pixels.shape[2] == 1
    tifffile.imwrite(
        path,
        pixels[..., 0] if grey else pixels,
        photometric="minisblack" if grey else "rgb",
        compression="zlib",
    )


_HEADER = re.compile(rb"(P[Ff])\s+(\d{1,9})\s+(\d{1,9})\s+(-?[0-9.eE+-]+)\s")
"""Kind (PF is RGB, Pf is grey), width, height, and a scale that is negative for little endian."""


def read_pfm(path: Path) -> NDArray[np.float32]:
    """Read a portable float map.

    Returns
    -------
    ndarray of float32, shape (H, W, 3) or (H, W, 1)

    Raises
    ------
    ValueError
        If the file is damaged.
    """
    content = path.read_bytes()
    header = _HEADER.match(content)
    if not header:
        raise ValueError("damaged or unsupported (no header of a float map); export it again")
    width, height, channels = int(header[2]), int(header[3]), 3 if header[1] == b"PF" else 1
    if len(content) - header.end() != 4 * width * height * channels:
        raise ValueError("damaged (its size is not that of its header); copy or export it again")
    order = "<f4" if float(header[4]) < 0 else ">f4"
    pixels = np.frombuffer(content, order, offset=header.end())
    return pixels.reshape(height, width, channels)[::-1].astype(np.float32)


def write_pfm(path: Path, pixels: NDArray[Any]) -> None:
    """Write floats (H, W, 3) or (H, W, 1) as a portable float map of little endian."""
    height, width, channels = pixels.shape
    kind = "PF" if channels == 3 else "Pf"
    with path.open("wb") as file:
        file.write(f"{kind}\n{width} {height}\n-1.0\n".encode())
        file.write(pixels[::-1].astype("<f4").tobytes())


Pixels = NDArray[Any]

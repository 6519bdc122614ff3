"""EXR, Radiance HDR and PNG of 16 bits, by OpenImageIO from the extra ``hdr``.

OpenImageIO is one wheel of 8 MB for Linux, macOS and Windows that needs NumPy alone. imageio reads
these files by a download or by OpenCV, and Pillow reads 8 bits of them or nothing.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[Any]

ADVICE = "needs OpenImageIO; type: pip install 'eigengs-dr[hdr]'"

MAX_PIXELS = 1 << 29
"""Largest number of pixels of a file; a damaged header may claim more than memory holds."""

MAX_HALF = 65_504.0
"""Largest finite float of 16 bits."""

GREY, RGB = ("Y",), ("R", "G", "B")


def is_installed() -> bool:
    """Return whether OpenImageIO can be imported."""
    try:
        _library()
    except ValueError:
        return False
    return True


def read(path: Path, integers: bool) -> Pixels:
    """Read a PNG of 16 bits (`integers`) or a Radiance HDR file; the suffix may be any.

    Returns
    -------
    ndarray of uint16 or float32, shape (H, W, C)
        The values of the file; alpha, if there is one, is not multiplied into the colours.

    Raises
    ------
    ValueError
        If the file is damaged, or OpenImageIO is missing.
    """
    oiio = _library()
    file = _open(oiio, path)
    return _pixels(oiio, file, oiio.UINT16 if integers else oiio.FLOAT)


def read_exr(path: Path) -> Pixels:
    """Read an EXR file of one image: R, G and B, perhaps alpha, or a single channel.

    Returns
    -------
    ndarray of float32, shape (H, W, 4), (H, W, 3) or (H, W, 1)
        The pixels of the data window.

    Raises
    ------
    ValueError
        If the file is damaged, or holds several parts or layers; or OpenImageIO is missing.
    """
    oiio = _library()
    file = _open(oiio, path)
    names = tuple(file.spec().channelnames)
    if file.seek_subimage(1, 0):
        raise ValueError("holds several parts; save one of them as a file of its own")
    if file.spec().deep:
        raise ValueError("holds deep pixels; flatten it first")
    if len(names) > 1 and names not in (RGB, (*RGB, "A")):
        shown = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
        raise ValueError(
            f"holds the channels {shown}; save the layer that is meant, as R, G and B, to a file "
            "of its own"
        )
    return _pixels(oiio, file, oiio.FLOAT)


def write(path: Path, pixels: Pixels, bits: int) -> None:
    """Write an EXR or HDR file, or a PNG of 16 bits.

    Parameters
    ----------
    path : Path
    pixels : ndarray of float32 or uint16, shape (H, W, 3) or (H, W, 1)
    bits : {16, 32}
        Bits of a value of an EXR file; with 16, values are clamped to +-65,504.

    Raises
    ------
    ValueError, OSError
        If OpenImageIO is missing, or the file cannot be written.
    """
    oiio = _library()
    if path.suffix.lower() == ".hdr":  # it has three channels
        pixels = np.broadcast_to(pixels, (*pixels.shape[:2], 3))
    height, width, channels = pixels.shape
    kind = "uint16" if pixels.dtype == np.uint16 else ("half" if bits == 16 else "float")
    if kind == "half":
        pixels = np.clip(pixels, -MAX_HALF, MAX_HALF)
    spec = oiio.ImageSpec(width, height, channels, kind)
    spec.channelnames = RGB if channels == 3 else GREY
    if path.suffix.lower() == ".exr":
        spec.attribute("compression", "zip")
    file = oiio.ImageOutput.create(str(path))
    if not file:
        raise OSError(_reason(oiio.geterror()))
    written = file.open(str(path), spec) and file.write_image(np.ascontiguousarray(pixels))
    if not (file.close() and written):
        raise OSError(_reason(file.geterror()))


def _library() -> ModuleType:
    try:
        import OpenImageIO
    except ImportError:
        raise ValueError(ADVICE) from None
    module: ModuleType = OpenImageIO
    return module


def _open(oiio: Any, path: Path) -> Any:
    """Open a file, and refuse one whose header claims too many pixels."""
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    file = oiio.ImageInput.open(str(path), config)
    if not file:
        raise ValueError(f"damaged or unsupported ({_reason(oiio.geterror())}); export it again")
    spec = file.spec()
    if spec.width * spec.height > MAX_PIXELS:
        raise ValueError(f"has more than {MAX_PIXELS:,} pixels; scale it down first")
    return file


def _pixels(oiio: Any, file: Any, kind: Any) -> Pixels:
    """Read the first image of a file."""
    file.seek_subimage(0, 0)
    pixels = file.read_image(0, 0, 0, file.spec().nchannels, kind)
    if pixels is None:
        raise ValueError(f"damaged or unsupported ({_reason(file.geterror())}); export it again")
    return np.asarray(pixels)


def _reason(message: str) -> str:
    """Return the first line of an error."""
    return (message.strip().splitlines() or ["unknown reason"])[0].strip()

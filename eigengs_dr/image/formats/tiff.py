"""TIFF files of 16 bits and of floats, by tifffile; Pillow keeps 8 bits and reads no floats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

DEEP = ("u2", "f2", "f4", "f8")
"""Types of values that this module reads."""

MAX_PIXELS = 1 << 29
"""Largest number of pixels, as of other files; a damaged header may claim more than fits."""

PLAIN = (1, 2)
"""Photometric interpretations: black is zero, and RGB."""


def read(path: Path) -> tuple[NDArray[Any], int] | None:
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


def write(path: Path, pixels: NDArray[Any]) -> None:
    """Write uint16 or float32 (H, W, 3) or (H, W, 1) without loss."""
    import tifffile

    grey = pixels.shape[2] == 1
    tifffile.imwrite(
        path,
        pixels[..., 0] if grey else pixels,
        photometric="minisblack" if grey else "rgb",
        compression="zlib",
    )

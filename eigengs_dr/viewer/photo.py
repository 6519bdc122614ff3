"""The photo in a page: a JPEG or PNG inside a link."""

from __future__ import annotations

from base64 import b64encode
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..image.io import to_8bit
from ..image.resize import resample

MAX_SIDE = 2048
"""Longest side of a photo in a page, in pixels; larger photos are scaled down."""

QUALITY = 92
"""Quality of JPEG."""


def check_aspect(pixels: NDArray[Any], size: tuple[int, int]) -> None:
    """Raise ValueError unless a photo has the aspect ratio of a set, to a pixel.

    Parameters
    ----------
    pixels : ndarray, shape (H, W, C)
    size : (int, int)
        Native width and height of the set.
    """
    height, width = pixels.shape[:2]
    if abs(width * size[1] - height * size[0]) > max(*size, width, height):
        raise ValueError(
            f"the photo has {width}x{height} pixels, the set {size[0]}x{size[1]}; "
            "give the photo that it was fitted to"
        )


def photo_uri(pixels: NDArray[Any]) -> str:
    """Return a link that holds a photo, as JPEG, or as PNG if that is smaller.

    Parameters
    ----------
    pixels : ndarray of float32, shape (H, W, 3) or (H, W, 1)
        sRGB or data; clamped.
    """
    from PIL import Image

    height, width = pixels.shape[:2]
    scale = min(1.0, MAX_SIDE / max(width, height))
    if scale < 1:
        pixels = resample(pixels, max(1, round(scale * width)), max(1, round(scale * height)))
    codes = to_8bit(pixels).astype(np.uint8)
    picture = Image.fromarray(codes[..., 0] if codes.shape[2] == 1 else codes)
    best = min(
        (_encoded(picture, "jpeg", quality=QUALITY, subsampling=0), "jpeg"),
        (_encoded(picture, "png", optimize=True), "png"),
        key=lambda file: len(file[0]),
    )
    return f"data:image/{best[1]};base64,{b64encode(best[0]).decode()}"


def _encoded(picture: Any, kind: str, **options: Any) -> bytes:
    file = BytesIO()
    picture.save(file, kind, **options)
    return file.getvalue()

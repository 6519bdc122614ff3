"""Images resized by antialiased bicubic resampling, and pictures in rows and columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


def resample(image: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Resize an image to any aspect ratio.

    Parameters
    ----------
    image : ndarray of float32, shape (H, W, C)
        Any number of channels and any finite values.
    width, height : int
        Size of the result in pixels, at least 1.

    Returns
    -------
    ndarray of float32, shape (height, width, C)
        Values are not clamped and may overshoot at edges by some percent. A copy if the size does
        not change.

    Raises
    ------
    ValueError
        If a side of the result is not positive.
    """
    return _resized(image, width, height, (0, 0, image.shape[1], image.shape[0]))


def center_crop(image: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Crop an image to its largest centred part with the aspect ratio of the result, and resize it.

    Parameters, result and errors as for `resample`. The part may begin inside a pixel: the centre
    of the image stays the centre exactly. Filters also use the pixels around the part.
    """
    rows, columns = image.shape[:2]
    scale = min(columns / max(width, 1), rows / max(height, 1))
    # Rounding must not move the box out of the image.
    left, top = max(0, (columns - scale * width) / 2), max(0, (rows - scale * height) / 2)
    return _resized(image, width, height, (left, top, columns - left, rows - top))


def _resized(
    image: NDArray[np.float32], width: int, height: int, box: tuple[float, float, float, float]
) -> NDArray[np.float32]:
    """Resample the part of an image inside a box (left, top, right, bottom) in pixels."""
    from PIL import Image

    if min(width, height) < 1:
        raise ValueError(f"size is {width}x{height}; both sides must be at least 1 pixel")
    if image.shape[:2] == (height, width):
        return image.copy()
    result = np.empty((height, width, image.shape[2]), np.float32)
    for channel in range(image.shape[2]):
        plane = Image.fromarray(np.ascontiguousarray(image[..., channel]))
        resized = plane.resize((width, height), Image.Resampling.BICUBIC, box)
        result[..., channel] = np.asarray(resized)
    return result


GAP = 8
"""Width of the white border after every picture, in pixels."""

SIZE = 10
"""Height of letters, in pixels."""

Picture = NDArray[Any]


def text_line(text: str, width: int, size: int = SIZE) -> Picture:
    """Draw a line of text, black on white.

    Parameters
    ----------
    text : str
        Text that is wider than the picture is cut off.
    width : int
        Width of the picture in pixels.
    size : int, optional
        Height of letters in pixels; the picture is a quarter higher.

    Returns
    -------
    ndarray of float64, shape (5 * size // 4, width, 3)
        RGB.
    """
    from PIL import Image, ImageDraw, ImageFont

    picture = Image.new("RGB", (width, 5 * size // 4), "white")
    font = ImageFont.load_default(size)
    ImageDraw.Draw(picture).text((0, 0), text, fill="black", font=font)
    return np.asarray(picture) / 255


def join_pictures(pictures: Sequence[Picture], axis: int, gap: int = GAP) -> Picture:
    """Join pictures below each other (axis 0) or side by side (axis 1), on white.

    Parameters
    ----------
    pictures : sequence of ndarray of float, shape (H, W, 3)
        At least one RGB picture. Pictures of different sizes are aligned at the top or left.
    axis : {0, 1}
    gap : int, optional
        Width of the white border after every picture, also after the last, in pixels.

    Returns
    -------
    ndarray of float, shape (H, W, 3)
        RGB, not clamped.
    """
    most = max(picture.shape[1 - axis] for picture in pictures)
    padded = []
    for picture in pictures:
        room = [(0, 0)] * 3
        room[axis], room[1 - axis] = (0, gap), (0, most - picture.shape[1 - axis])
        padded.append(np.pad(picture, room, constant_values=1))
    return np.concatenate(padded, axis)

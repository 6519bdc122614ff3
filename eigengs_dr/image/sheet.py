"""Pictures in rows and columns, with lines of text between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

GAP = 8
"""Width of the white border after every picture, in pixels."""

LETTER_HEIGHT = 10
"""Height of letters, in pixels."""

Picture = NDArray[np.floating]


def text_line(text: str, width: int, size: int = LETTER_HEIGHT) -> Picture:
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
    longest = max(picture.shape[1 - axis] for picture in pictures)
    padded = []
    for picture in pictures:
        padding = [(0, 0)] * 3
        padding[axis], padding[1 - axis] = (0, gap), (0, longest - picture.shape[1 - axis])
        padded.append(np.pad(picture, padding, constant_values=1))
    return np.concatenate(padded, axis)

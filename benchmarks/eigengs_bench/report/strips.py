"""Strips of pictures with captions: rows of fits, and the posters of `inverse`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image as pillow

from eigengs_dr.atomic import replacing
from eigengs_dr.images import to_8bit
from eigengs_dr.resampling import resampled
from eigengs_dr.strips import GAP, joined, line

CELL, LETTERS, HEADING = 160, 13, 15
"""Longer side of a picture, and heights of the letters below it and above a row, in pixels."""

QUALITY, PALETTE = 88, 256
"""Of JPEG files; colours of PNG files, of which photos in all their colours would be large."""

Picture = NDArray[Any]


class Cell(NamedTuple):
    """A picture of a strip: RGB, shape (H, W, 3), not clamped, and the line below it."""

    caption: str
    picture: Picture


class Line(NamedTuple):
    """Pictures side by side, and the line above them."""

    heading: str
    cells: Sequence[Cell]


def strip(lines: Sequence[Line], credit: str = "", side: int = CELL, gap: int = GAP) -> Picture:
    """Put rows of pictures below each other.

    Parameters
    ----------
    lines : sequence of Line
    credit : str, optional
        A last line: whose images these are.
    side : int, optional
        Longer side of a picture, in pixels.
    gap : int, optional
        White pixels between pictures.

    Returns
    -------
    ndarray of float, shape (H, W, 3)
        RGB on white, not clamped.
    """
    drawn = []
    for heading, cells in lines:
        row = joined([_cell(*cell, side) for cell in cells], 1, gap)
        above = [line(heading, row.shape[1], HEADING)] if heading else []
        drawn.append(joined([*above, row], 0, 2))
    if credit:
        drawn.append(line(f"Images: {credit}", drawn[0].shape[1], LETTERS))
    return joined(drawn, 0, gap)


def save_strip(path: str | os.PathLike[str], picture: Picture) -> None:
    """Write a strip, small: a JPEG of moderate quality, or a PNG of 256 colours.

    Parameters
    ----------
    path : path-like
        Ends in .jpg or .png.
    picture : ndarray of float, shape (H, W, 3)
        RGB, clamped.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    image = pillow.fromarray(to_8bit(picture).astype(np.uint8))
    with replacing(path) as temporary:
        if Path(path).suffix == ".png":
            image.quantize(PALETTE).save(temporary, optimize=True)
        else:
            image.save(temporary, quality=QUALITY)


def _cell(caption: str, picture: Picture, side: int) -> Picture:
    """A picture above its line."""
    height, width = picture.shape[:2]
    scale = side / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    scaled = resampled(np.clip(picture, 0, 1).astype(np.float32), *size)
    return joined([scaled, line(caption, size[0], LETTERS)], 0, 0)

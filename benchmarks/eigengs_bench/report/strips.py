"""Strips of pictures with captions: rows of fits, and the posters of `inverse`."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as pillow

from eigengs_dr.atomic import replacing
from eigengs_dr.images import to_8bit
from eigengs_dr.resampling import resampled
from eigengs_dr.strips import GAP, joined, line

# Longer side of a picture, and heights of the letters below it and above a row, in pixels.
CELL, LETTERS, HEADING = 160, 13, 15

Picture = NDArray[Any]
Cell = tuple[str, Picture]  # the line below a picture, and the picture: RGB, not clamped


def strip(
    rows: Sequence[tuple[str, Sequence[Cell]]], credit: str = "", side: int = CELL, gap: int = GAP
) -> Picture:
    """Put rows of pictures below each other, each below its heading; RGB on white, not clamped."""
    drawn = []
    for heading, cells in rows:
        row = joined([_cell(*cell, side) for cell in cells], 1, gap)
        above = [line(heading, row.shape[1], HEADING)] if heading else []
        drawn.append(joined([*above, row], 0, 2))
    if credit:
        drawn.append(line(f"Images: {credit}", drawn[0].shape[1], LETTERS))
    return joined(drawn, 0, gap)


def save_strip(path: str | os.PathLike[str], picture: Picture) -> None:
    """Write a strip, small: a .jpg of moderate quality, or a .png of 256 colours."""
    image = pillow.fromarray(to_8bit(picture).astype(np.uint8))
    with replacing(path) as temporary:
        if Path(path).suffix.lower() == ".png":
            image.quantize(256).save(temporary, optimize=True)
        else:
            image.save(temporary, quality=88)


def _cell(caption: str, picture: Picture, side: int) -> Picture:
    """A picture above its line."""
    height, width = picture.shape[:2]
    scale = side / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    scaled = resampled(np.clip(picture, 0, 1).astype(np.float32), *size)
    return joined([scaled, line(caption, size[0], LETTERS)], 0, 0)

"""Strips of pictures with captions: rows of fits, and the posters of `inverse`."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as pillow

from eigengs_dr.image.io import to_8bit
from eigengs_dr.image.montage import GAP, join_pictures, text_line
from eigengs_dr.image.resize import resample
from eigengs_dr.storage.atomic import atomic_write

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
        row = join_pictures([_cell(*cell, side) for cell in cells], 1, gap)
        above = [text_line(heading, row.shape[1], HEADING)] if heading else []
        drawn.append(join_pictures([*above, row], 0, 2))
    if credit:
        drawn.append(text_line(f"Images: {credit}", drawn[0].shape[1], LETTERS))
    return join_pictures(drawn, 0, gap)


def save_strip(path: str | os.PathLike[str], picture: Picture) -> None:
    """Write a strip, small: a .jpg of moderate quality, or a .png of 256 colours."""
    image = pillow.fromarray(to_8bit(picture).astype(np.uint8))
    with atomic_write(path) as temporary:
        if Path(path).suffix.lower() == ".png":
            image.quantize(256).save(temporary, optimize=True)
        else:
            image.save(temporary, quality=88)


def _cell(caption: str, picture: Picture, side: int) -> Picture:
    """A picture above its line."""
    height, width = picture.shape[:2]
    scale = side / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    scaled = resample(np.clip(picture, 0, 1).astype(np.float32), *size)
    return join_pictures([scaled, text_line(caption, size[0], LETTERS)], 0, 0)

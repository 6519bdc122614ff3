"""The memory of a fit, said before the image is read."""

from __future__ import annotations

from pathlib import Path

from ..fitting.memory import check_memory, estimate_memory
from ..fitting.options import FitOptions, default_count
from .console import say

NOTABLE = 1_000_000_000
"""Bytes from which on a fit says its memory."""

TURNED = range(5, 9)
"""EXIF orientations that swap width and height."""

GREY = ("1", "L", "I", "I;16", "I;16B", "I;16L", "F")
"""Modes of Pillow for images of one channel."""

ORIENTATION = 0x0112
"""EXIF tag of the orientation."""


def announce_memory(path: Path, options: FitOptions, quiet: bool) -> None:
    """Say how much memory the fit of a large image takes, from the header of its file.

    Parameters
    ----------
    path : Path
        An image file. A file that cannot be opened is left to `eigengs_dr.load_image`, which says
        why.
    options : FitOptions
        A search for the number of Gaussians counts with that of its first try.
    quiet : bool
        Say nothing.

    Raises
    ------
    ValueError
        If this machine has too little memory.
    """
    from ..fitting.fit import PIXELS_PER_FIRST_GAUSSIAN

    size = _image_size(path)
    if size is None:
        return
    width, height, grey = size
    count = options.gaussians or default_count(width * height)
    if options.target_psnr is not None:
        count = max(1, width * height // PIXELS_PER_FIRST_GAUSSIAN)
    arguments = width, height, 1 if grey and options.color == "data" else 3, count
    try:
        line = check_memory(*arguments)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    if estimate_memory(*arguments) >= NOTABLE and not quiet:
        say(line)


def _image_size(path: Path) -> tuple[int, int, bool] | None:
    """Return width, height and whether an image file is grey, or None if it cannot be opened."""
    from PIL import Image

    try:
        with Image.open(path) as file:
            width, height = file.size
            # Pillow decodes a PNG file to find its EXIF data; they seldom turn it.
            turned = file.format != "PNG" and file.getexif().get(ORIENTATION) in TURNED
            grey = file.mode in GREY
    except Exception:  # Pillow's decoders raise many types
        return None
    return (height, width, grey) if turned else (width, height, grey)

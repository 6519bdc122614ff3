"""The memory of a fit, said before the image is read."""

from __future__ import annotations

from pathlib import Path

from ..fitting.memory import check_memory, estimate_memory, usable_memory
from ..fitting.options import PIXELS_PER_FIRST_GAUSSIAN, FitOptions, default_count
from ..image.color import rendered_as
from .console import say

NOTABLE = 1_000_000_000
"""Bytes from which on a fit says its memory."""

COMFORTABLE = 0.5
"""Share of the usable memory up to which an image is fitted as a whole."""

TURNED = range(5, 9)
"""EXIF orientations that swap width and height."""

ORIENTATION = 0x0112
"""EXIF tag of the orientation."""


def announce_memory(path: Path | str, options: FitOptions, quiet: bool) -> None:
    """Say how much memory the fit of a large image takes, from the header of its file.

    Parameters
    ----------
    path : Path or str
        An image file. A file that cannot be opened is left to `eigengs_dr.load_image`, which says
        why.
    options : FitOptions
        A search for the number of Gaussians counts with that of its first try.
    quiet : bool
        Say nothing.

    Raises
    ------
    ValueError
        If this process may use too little memory.
    """
    problem = _problem(path, options)
    if problem is None:
        return
    try:
        line = check_memory(*problem)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    if estimate_memory(*problem) >= NOTABLE and not quiet:
        say(line)


def needs_blocks(path: Path | str, options: FitOptions) -> bool:
    """Return whether the fit of a whole image takes more than a comfortable share of the memory."""
    problem, usable = _problem(path, options), usable_memory()
    if problem is None or usable is None:
        return False
    return estimate_memory(*problem) > COMFORTABLE * usable


def _problem(path: Path | str, options: FitOptions) -> tuple[int, int, int, int] | None:
    """Return width, height, channels and Gaussians of a fit, or None if they are not known."""
    size = _image_size(path)
    if size is None:
        return None
    width, height, grey = size
    count = options.gaussians or default_count(width * height)
    if options.target_psnr is not None:
        count = max(1, width * height // PIXELS_PER_FIRST_GAUSSIAN)
    return width, height, 1 if grey and rendered_as(options.space) is None else 3, count


def _image_size(path: Path | str) -> tuple[int, int, bool] | None:
    """Return width, height and whether an image file is grey, or None if it cannot be opened."""
    from ..blocks.source import GREY
    from ..blocks.tiff import TIFF_SUFFIXES, window_shape
    from ..image.formats.pillow import open_header

    if isinstance(path, str):  # a URL, which is read once
        return None
    if path.suffix.lower() in TIFF_SUFFIXES and (shape := window_shape(str(path))):
        return shape[1], shape[0], shape[2] == 1
    try:
        with open_header(path) as file:
            width, height = file.size
            # Pillow decodes a PNG file to find its EXIF data; they seldom turn it.
            turned = file.format != "PNG" and file.getexif().get(ORIENTATION) in TURNED
            grey = file.mode in GREY
    except Exception:  # Pillow's decoders raise many types
        return None
    return (height, width, grey) if turned else (width, height, grey)

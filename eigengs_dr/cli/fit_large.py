"""The command ``eigengs-dr fit`` by blocks, and the memory of a fit before the image is read."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Any

import click

from ..fitting.memory import check_memory, estimate_memory, usable_memory
from ..fitting.options import PIXELS_PER_FIRST_GAUSSIAN, FitOptions, default_count
from ..image.color import rendered_as
from .console import progress_bar, say

NOTABLE = 1_000_000_000
"""Bytes from which on a fit says its memory."""

COMFORTABLE = 0.5
"""Share of the usable memory up to which an image is fitted as a whole."""

TURNED = range(5, 9)
"""EXIF orientations that swap width and height."""

ORIENTATION = 0x0112
"""EXIF tag of the orientation."""

WORDS = {
    "survey": "look at all blocks",
    "place": "place",
    "density": "find where error is left",
    "fit": "fit",
    "measure": "measure",
}
"""What the bar says in each stage."""


def check_large(options: FitOptions, preview: Path | None, several: bool = False) -> None:
    """Raise ValueError for options that a fit by blocks does not have."""
    if options.preset != "default" or options.placement != "adaptive":
        raise ValueError("--blocks needs the preset and the init that are the default")
    if several:
        raise ValueError("--blocks fits one image; run the command for each image")
    for name, value in (
        ("--target-psnr", options.target_psnr),
        ("--levels", options.levels),
        ("--preview", preview),
    ):
        if value is not None:
            raise ValueError(f"--blocks and {name} exclude each other; leave one of them out")


def block_side(
    path: Path | str,
    several: bool,
    options: FitOptions,
    preview: Path | None,
) -> int | None:
    """Return the side of the blocks, if a whole image would take too much memory."""
    if several or not needs_blocks(path, options):
        return None
    try:
        check_large(options, preview)
    except ValueError:
        return None
    from ..blocks.fit_large import BLOCK_SIDE

    say(f"{path}: a fit of the whole takes too much memory; it is fitted by blocks")
    return BLOCK_SIDE


def fit_by_blocks(
    path: Path | str, output: Path, side: int, options: FitOptions, quiet: bool, client: Any = None
) -> tuple[dict[str, Any], bool]:
    """Fit one image by blocks into a file.

    Parameters
    ----------
    path : Path or str
        A file or a URL.
    output : Path
    side : int
        Largest side of a block in pixels.
    options : FitOptions
        Options that `check_large` accepts.
    quiet : bool
        Show no bar and no summary.
    client : distributed.Client, optional
        Where blocks are fitted.

    Returns
    -------
    record : dict
        The figures for a report.
    interrupted : bool
        Whether Ctrl-C ended the run; blocks that are done then wait beside the output.
    """
    from ..blocks.fit_large import fit_large

    names = ("gaussians", "iterations", "space", "solve_steps", "cutoff", "backend", "encoding")
    settings = {name: getattr(options, name) for name in names}
    started = time.perf_counter()
    record: dict[str, Any] = {"input": str(path), "output": str(output), "stopped": "interrupted"}
    with progress_bar(quiet) as show:
        progress = partial(_show, show, Path(path).name)
        try:
            result = fit_large(
                path, output, block=side, progress=progress, client=client, **settings
            )
        except KeyboardInterrupt:
            record["seconds"] = time.perf_counter() - started
            say(
                f"interrupted; finished blocks are in {output}.checkpoint; the same command goes on"
            )
            return record, True
    record |= {
        "stopped": "iterations",
        "width": result.gaussians.width,
        "height": result.gaussians.height,
        "gaussians": len(result.gaussians),
        "iterations": result.iterations,
        "blocks": result.blocks,
        "blocks_resumed": result.resumed,
        "seconds": result.seconds,
        "psnr_ycbcr": result.psnr_ycbcr,
        "psnr_rgb": result.psnr_rgb,
    }
    if not quiet:
        click.echo(_summary(record, options.space))
    return record, False


def _show(show: Any, name: str, done: int, total: int, row: dict[str, Any]) -> None:
    show(f"{name}: {WORDS[row['stage']]}", done, total)


def _summary(record: dict[str, Any], space: str) -> str:
    """Describe a fit for a terminal."""
    from ..image.metrics import float_space

    return (
        "{input}: {width}x{height} in {blocks} blocks, {gaussians:,} Gaussians, "
        "{iterations} iterations in {seconds:.1f} s\n"
        "  psnr_{space} {psnr_ycbcr:.2f} dB, psnr_rgb {psnr_rgb:.2f} dB\n  wrote {output}"
    ).format(**record, space=float_space(space))


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
    from ..blocks.source import GREY, TIFF_SUFFIXES, window_shape
    from ..image.formats import open_header

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

"""The command ``eigengs-dr fit`` for an image that is fitted block by block."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .console import progress_bar, say
from .memory import needs_blocks

if TYPE_CHECKING:
    from ..fitting.options import FitOptions, Levels

WORDS = {
    "survey": "look at all blocks",
    "place": "place",
    "density": "find where error is left",
    "fit": "fit",
    "measure": "measure",
}
"""What the bar says in each stage."""


def check_large(
    options: FitOptions, levels: Levels | None, preview: Path | None, several: bool = False
) -> None:
    """Raise ValueError for options that a fit by blocks does not have."""
    if options.preset != "default" or options.initializer != "adaptive":
        raise ValueError("--blocks needs the preset and the init that are the default")
    if several:
        raise ValueError("--blocks fits one image; run the command for each image")
    for name, value in (
        ("--target-psnr", options.target_psnr),
        ("--levels", levels),
        ("--preview", preview),
    ):
        if value is not None:
            raise ValueError(f"--blocks and {name} exclude each other; leave one of them out")


def block_side(
    path: Path | str,
    several: bool,
    options: FitOptions,
    levels: Levels | None,
    preview: Path | None,
) -> int | None:
    """Return the side of the blocks, if a whole image would take too much memory."""
    if several or not needs_blocks(path, options):
        return None
    try:
        check_large(options, levels, preview)
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

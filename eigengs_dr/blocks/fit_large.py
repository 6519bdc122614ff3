"""The function `fit_large`, which fits images of any size block by block."""

from __future__ import annotations

import os
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..backend.doors import shows_progress, takes_numbers
from ..backend.interrupts import defer_interrupts
from ..backend.selection import select
from ..cluster.client import executor_for
from ..fitting.method import DEFAULT, Method
from ..fitting.objective import restored
from ..fitting.options import FitOptions, named_options
from ..gaussian.file import FitFigures, check_suffix, write
from ..gaussian.gaussians import Gaussians
from ..image.metrics import psnr_from_mse
from ..image.space import space_of
from ..storage.atomic import require_writable
from ..storage.checkpoint import open_checkpoint
from .block import Settings
from .grid import Block, choose_halo, divide
from .run import Run
from .windows import Source, open_source

BLOCK_SIDE = 1024
"""Default side of a block in pixels."""

MIN_SIDE = 32
"""Smallest side of a block in pixels."""

PIXELS_PER_GAUSSIAN = 20
"""Default number of pixels per Gaussian."""

MAX_SPACING = 16.0
"""Largest mean distance of Gaussians in pixels. With fewer Gaussians, halos would be as large as
blocks, and a smaller version of the image gives the same set."""


@dataclass(frozen=True)
class LargeFit:
    """Result of `fit_large`.

    Attributes
    ----------
    gaussians : Gaussians
        The fitted set, with its Gaussians block by block.
    psnr_ycbcr, psnr_rgb : float
        PSNR in dB, as in the trace of `eigengs_dr.Fit`, measured block by block.
    blocks : int
        Number of blocks.
    resumed : int
        Number of block fits, over all rounds, taken from an earlier call.
    iterations : int
        Number of steps of every block.
    seconds : float
        Total time of this call.
    """

    gaussians: Gaussians = field(repr=False)
    psnr_ycbcr: float
    psnr_rgb: float
    blocks: int
    resumed: int
    iterations: int
    seconds: float


@named_options
@shows_progress
@takes_numbers
def fit_large(
    image: object,
    output: str | os.PathLike[str] | None = None,
    *,
    gaussians: int | None = None,
    iterations: int = 1000,
    block: int = BLOCK_SIDE,
    space: str = "ycbcr",
    method: Method = DEFAULT,
    seed: int = 0,
    backend: str | None = None,
    progress: Any = None,
    client: object = None,
    encoding: str | None = None,
) -> LargeFit:
    """Fit an image of any size block by block, in the memory of one block.

    Parameters
    ----------
    image : path-like or array
        A TIFF file with strips or tiles and a ``.npy`` file are read by windows; other files are
        decoded completely, with 3 bytes per pixel. An array (H, W, 3), (H, W, 1) or (H, W) of
        NumPy (also memory-mapped), zarr or Dask is read by slices.
    output : path-like, optional
        The ``.npz`` file of the result. Until the run succeeds, finished blocks are stored in a
        folder beside it, with the same name and ".checkpoint" added. By default the result and the
        blocks stay in memory.
    gaussians : int, optional
        Number of Gaussians, at least one per 256 pixels; by default one per 20 pixels. They are
        distributed to the blocks according to the image.
    iterations : int, optional
        Number of steps for each block.
    block : int, optional
        Largest side of a block in pixels, at least 32.
    space, method, seed, backend : optional
        See `eigengs_dr.fit`. The placement is always that of `eigengs_dr.DEFAULT`.
    progress : bool or callable, optional
        By default a bar, in a terminal or a notebook, after two seconds; False shows none.
        A function is called as ``progress(done, total, row)``, with the progress of a stage in
        blocks or in steps of blocks. The row has the keys stage ("survey", "place", "density",
        "place", "fit", "measure", in this order; the first "place" and "density" only in long
        fits) and blocks, their number.
    client : distributed.Client, optional
        Dask cluster that fits the blocks; by default they are fitted in this process.
    encoding : {"srgb", "linear"}, optional
        The encoding of the pixels, see `eigengs_dr.fit`. For light above 1, give the space "log" or
        "radiance", because the image is not scanned first.

    Returns
    -------
    LargeFit

    Raises
    ------
    ValueError
        If the image is unusable, an argument is out of range, or the folder of an interrupted run
        belongs to another image or to other options.
    OSError
        If the output cannot be written.
    BackendError
        If the backend is not available.
    ClusterError
        If the cluster cannot be used or is lost, or a block repeatedly crashes its worker. The same
        call continues the run.
    KeyboardInterrupt
        After Ctrl-C or SIGTERM. The folder keeps the finished blocks: repeat the call to continue.

    Notes
    -----
    The result is determined by the seed. It does not depend on the order of the blocks, on where
    they are fitted, or on interruptions; a run that is continued on another processor differs in
    the last bits.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> result = eg.fit_large(eg.sample("coffee")[:96, :128], iterations=10, block=64)
    >>> result.blocks, len(result.gaussians)
    (4, 614)
    """
    started = time.perf_counter()
    colors = space_of(space)
    options = FitOptions(
        gaussians=gaussians,
        iterations=iterations,
        space=colors,
        method=method,
        seed=seed,
        backend=backend,
        encoding=encoding,
    )
    source = open_source(image, not colors.is_color, encoding)
    blocks, settings = plan(source, options, block)
    select(backend)
    keep: AbstractContextManager = nullcontext()
    if output is not None:
        check_suffix(output)
        require_writable(output)
        names = ("iterations", "space", "seed", "encoding")
        stored = {name: getattr(options, name) for name in names}
        stored |= {"method": repr(method), "gaussians": settings.gaussians, "block": block}
        keep = open_checkpoint(output, source.identity | stored, [])
    with (
        keep as checkpoint,
        defer_interrupts() if client is None else nullcontext() as interrupted,
    ):
        run = Run(source, blocks, settings, executor_for(client), checkpoint, progress, interrupted)
        data = run.fit()
        errors = run.measure(data)
        ycbcr, rgb = (psnr_from_mse(e / (3 * source.width * source.height)) for e in errors)
        fitted = Gaussians.from_data(data, backend)
        result = restored(fitted, [run.settings.affine] * fitted.channels)
        if output is not None:
            name = Path(image).name if isinstance(image, (str, os.PathLike)) else ""
            write(output, result.data(), FitFigures(ycbcr, rgb, iterations, name))
    seconds = time.perf_counter() - started
    return LargeFit(result, ycbcr, rgb, len(blocks), run.resumed, iterations, seconds)


def plan(image: Source, options: FitOptions, side: int) -> tuple[list[Block], Settings]:
    """Return the blocks of a fit, and the settings that their tasks share.

    Raises
    ------
    ValueError
        If the blocks are too small, or there are too few or too many Gaussians.
    """
    if side < MIN_SIDE:
        raise ValueError(f"block is {side}; it must be at least {MIN_SIDE} pixels")
    pixels = image.width * image.height
    count = options.gaussians
    if count is None:
        count = max(1, pixels // PIXELS_PER_GAUSSIAN)
    assert isinstance(count, int)
    spacing = (pixels / max(count, 1)) ** 0.5
    blocks = divide(image.width, image.height, side, choose_halo(spacing))
    least = max(len(blocks), -(-pixels // round(MAX_SPACING**2)))
    if count < least:
        raise ValueError(
            f"gaussians is {count}; blocks of {side} pixels on {image.width}x{image.height} need "
            f"at least {least:,}: use more, or fit a smaller version of the image"
        )
    if count > pixels:
        raise ValueError(
            f"gaussians is {count}; an image of {image.width}x{image.height} takes 1 to {pixels}"
        )
    return blocks, Settings(options, count, spacing)

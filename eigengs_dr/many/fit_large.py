"""The function `fit_large`, which fits images of any size block by block, and its stages."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..backend.entry_points import checks_types, shows_progress
from ..backend.interrupts import Interrupted, defer_interrupts
from ..backend.selection import select
from ..backend.types import Arrays
from ..cluster import Executor, Value, completed, executor_for
from ..fitting.channels import restored
from ..fitting.method import DEFAULT, Method
from ..fitting.options import COLOR_PARAMETERS, FitOptions, named_options
from ..gaussian.file import SetData, check_suffix, write_set
from ..gaussian.gaussians import Gaussians
from ..image.metrics import psnr_from_mse
from ..image.space import Extent, exposure_of, space_of
from ..storage.atomic import require_writable
from ..storage.checkpoint import Checkpoint, open_checkpoint
from ..storage.memory import check_usable
from ..storage.npz import COPIES
from .block import (
    BlockSettings,
    BlockTask,
    exchange_rounds,
    find_density,
    fit_block,
    measure_extents,
    place_in_block,
    survey,
)
from .draw import block_errors
from .grid import Block, BlockSets, allocate, choose_halo, divide
from .images import ImageRow, RowProgress, described, list_sources
from .run import figures_of, run_pieces
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
@checks_types
def fit_large(
    image: ArrayLike | os.PathLike[str],
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
        blocks or in steps of blocks. The status of the `eigengs_dr.ImageRow` is the stage:
        "survey", "place", "density", "place", "fit", "measure", in this order; the first "place"
        and "density" only in long fits.
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
    Interrupted
        After Ctrl-C or SIGTERM: a `KeyboardInterrupt` with the row of the stage. The folder keeps
        the finished blocks: repeat the call to continue.

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
    [named] = list_sources([image])
    size = {"width": source.width, "height": source.height}
    row = named.row("", gaussians=settings.gaussians, iterations=iterations, **size)
    keep: AbstractContextManager = nullcontext()
    if output is not None:
        check_suffix(output)
        require_writable(output)
        row = replace(row, output=Path(output))
        names = ("iterations", "space", "seed", "encoding")
        stored = {name: getattr(options, name) for name in names}
        stored |= {"method": described(method), "gaussians": settings.gaussians, "block": block}
        keep = open_checkpoint(output, source.identity | stored, [])
    run = LargeRun(source, blocks, settings, executor_for(client), row, progress)
    try:
        with (
            keep as run.checkpoint,
            defer_interrupts() if client is None else nullcontext() as run.interrupted,
        ):
            data = run.fit()
            errors = run.measure(data)
            ycbcr, rgb = (psnr_from_mse(e / (3 * source.width * source.height)) for e in errors)
            fitted = Gaussians.from_data(data, backend)
            result = restored(fitted, [run.settings.affine] * fitted.channels)
            if output is not None:
                measured = replace(row, psnr_ycbcr=ycbcr, psnr_rgb=rgb)
                write_set(output, result.data(), figures_of(measured))
    except KeyboardInterrupt:
        kept = "repeat the call to continue" if output is not None else "no output keeps the blocks"
        raise Interrupted(run.row, f"the run was interrupted; {kept}") from None
    seconds = time.perf_counter() - started
    return LargeFit(result, ycbcr, rgb, len(blocks), run.resumed, iterations, seconds)


def plan(image: Source, options: FitOptions, side: int) -> tuple[list[Block], BlockSettings]:
    """Return the blocks of a fit, and the settings that their tasks share.

    Raises
    ------
    ValueError
        If the blocks are too small, or there are too few Gaussians, or too many for the image or
        the memory.
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
    needed = COPIES * 4.0 * count * (COLOR_PARAMETERS + image.channels)
    what = f"{image.name}: {count:,} Gaussians on {image.width}x{image.height} pixels"
    check_usable(needed, what, "use fewer, or fit parts of the image")
    return blocks, BlockSettings(options, count, spacing)


@dataclass
class LargeRun:
    """One call of `eigengs_dr.fit_large`.

    Attributes
    ----------
    image : Source
    blocks : list of Block
    settings : BlockSettings
        The unit and the background are set by `fit`.
    executor : Executor
    row : ImageRow
        The row of the image; its status is the stage.
    progress : callable or None
        See `eigengs_dr.fit_large`.
    checkpoint : Checkpoint or None
        Storage of finished blocks until the end of the run.
    interrupted : callable or None
        ``interrupted()`` returns whether to end the run; None on a cluster.
    resumed : int
        Number of block fits, over all rounds, taken from an earlier call.
    done, total : int
        The progress of the stage, in blocks or in steps of blocks.
    """

    image: Source
    blocks: list[Block]
    settings: BlockSettings
    executor: Executor
    row: ImageRow
    progress: RowProgress | None = None
    checkpoint: Checkpoint | None = None
    interrupted: Callable[[], bool] | None = None
    resumed: int = 0
    done: int = 0
    total: int = 0

    def fit(self) -> SetData:
        """Place and fit all Gaussians; a long fit places them again according to the error."""
        options = self.settings.options
        steps = options.iterations
        first = options.method.first_phase(steps)
        mass = self._survey()
        placed = self._place(mass)
        if first:
            placed = self._place(*self._find_density(placed, first))
        sets = self._fit_blocks(placed, steps - first)
        background = np.array(self.settings.background, np.float32)
        return SetData(
            sets.arrays | {"background": background},
            (self.image.width, self.image.height),
            self.settings.space,
            options.method.cutoff,
        )

    def measure(self, data: SetData) -> tuple[float, float]:
        """Return the sums of the squared errors for psnr_ycbcr and psnr_rgb.

        The set is in the unit of the fit.
        """
        self._begin("measure", len(self.blocks))
        band, in_band = slice(0, 0), data

        def task_of(block: Block) -> BlockTask:
            nonlocal band, in_band
            if block.rows != band:  # cropping first to a row of blocks is faster
                band = block.rows
                in_band = data.crop((0, band.start), (self.image.width, band.stop - band.start))
            size = (block.columns.stop - block.columns.start, band.stop - band.start)
            part = in_band.crop((block.columns.start, 0), size)
            return BlockTask(self.image.window(block.rows, block.columns), block, part.arrays)

        errors = self._each(block_errors, task_of)
        ycbcr, rgb = np.sum(errors, axis=0).tolist()
        return ycbcr, rgb

    def _survey(self) -> NDArray[np.float64]:
        """Return the masses of all blocks; set the unit, and the background to the mean colour.

        The image is read twice, because the unit depends on all blocks.
        """
        self._begin("survey", 2 * len(self.blocks))
        extents, space = self._each(measure_extents, self._task), self.settings.space
        values, light = (reduce(Extent.joined, part) for part in zip(*extents, strict=True))
        self.settings = self.settings._replace(
            affine=space.unit(values),
            is_of_codes=values.is_of_codes,
            exposure=1.0 if space.bounded else exposure_of(light.mean),
        )
        figures = np.array(self._each(survey, self._task))
        if self.checkpoint is not None:
            figures = _stored_figures(self.checkpoint, figures)
        mean = figures[:, 1:].sum(axis=0) / (self.image.width * self.image.height)
        self.settings = self.settings._replace(background=tuple(mean.tolist()))
        return figures[:, 0]

    def _place(self, mass: NDArray[np.float64], old: BlockSets | None = None) -> BlockSets:
        """Allocate the Gaussians to the blocks by their masses, and place them."""
        pixels = np.array([block.pixels for block in self.blocks])
        counts = allocate(mass, pixels, self.settings.gaussians)
        placed = BlockSets(self.blocks, counts, ("mean", "factor"))
        self._begin("place", len(self.blocks))

        def task_of(block: Block) -> BlockTask:
            density = None if old is None else old.in_window(block)[0]
            return self._task(block, arrays=density, gaussians=int(counts[block.number]))

        self._each(place_in_block, task_of, placed.put)
        return placed

    def _find_density(self, placed: BlockSets, steps: int) -> tuple[NDArray[np.float64], BlockSets]:
        """Fit all blocks for some steps; return masses, means and ratios of the new density."""
        old = BlockSets(self.blocks, placed.counts, ("mean", "factor", "ratio"))
        mass = np.empty(len(self.blocks))
        task = partial(self._fit_task, sets=placed, steps=steps, part=range(steps))
        self._begin("density", len(self.blocks) * steps)

        def put(block: Block, arrays: Arrays) -> None:
            mass[block.number] = arrays["mass"][0]
            old.put(block, arrays)

        self._each(self._told(find_density), task, put, "density-", steps)
        return mass, old

    def _fit_blocks(self, sets: BlockSets, steps: int) -> BlockSets:
        """Fit all blocks, round by round, from sets without colours."""
        parts = exchange_rounds(self.settings.options.method, steps)
        self._begin("fit", len(self.blocks) * steps)
        first = self._last_complete_round(len(parts))
        self.resumed += first * len(self.blocks)
        self._advance(len(self.blocks) * parts[first].start)
        for number, part in enumerate(parts[first:], start=first):
            fitted = BlockSets(
                self.blocks,
                sets.counts,
                ("mean", "factor", "color"),
                self.image.channels,
                self.settings.options.method.cutoff,
            )
            task = partial(self._fit_task, sets=sets, steps=steps, part=part)
            kept = f"fit{number}-"
            self._each(self._told(fit_block), task, fitted.put, kept, len(part))
            sets = fitted
            if self.checkpoint is not None:
                self.checkpoint.remove(f"fit{number - 1}-*")
        return sets

    def _last_complete_round(self, number: int) -> int:
        """Return the last of some rounds in which an earlier call fitted all blocks, or 0."""
        stored = self.checkpoint
        complete = [
            k
            for k in range(number)
            if stored and all(stored.holds(f"fit{k}-{block.number}") for block in self.blocks)
        ]
        return max(complete, default=0)

    def _task(self, block: Block, **content: Any) -> BlockTask:
        window = self.image.window(block.window_rows, block.window_columns)
        return BlockTask(window, block, **content)

    def _fit_task(self, block: Block, sets: BlockSets, steps: int, part: range) -> BlockTask:
        """Return the task of a block: its window, the Gaussians in it, and others that touch it."""
        arrays, members = sets.in_window(block)
        fixed = sets.around(block) if "color" in arrays else None
        return self._task(
            block, arrays=arrays, members=members, fixed=fixed, iterations=steps, part=part
        )

    def _told(self, fit: Callable[..., Arrays]) -> Callable[..., Arrays]:
        """Let a fit in this process tell its steps, and stop between two of them."""
        return fit if self.interrupted is None else partial(fit, step_done=self._tell)

    def _each(
        self,
        function: Callable[..., Value],
        task_of: Callable[[Block], BlockTask],
        put: Callable[[Block, Value], None] | None = None,
        kept: str = "",
        steps: int = 1,
    ) -> list[Value]:
        """Call a function with the task of each block.

        Parameters
        ----------
        function : callable
            ``function(task, settings)``.
        task_of : callable
            Returns the task of a block.
        put : callable, optional
            ``put(block, value)`` takes each result. By default results are returned.
        kept : str, optional
            Start of the names in the checkpoint: results that it holds are taken from there, others
            are stored. By default no results are kept.
        steps : int, optional
            What a block counts in the progress.

        Returns
        -------
        list
            The results in the order of the blocks, unless `put` takes them.
        """
        results: dict[int, Value] = {}
        store = self.checkpoint if kept else None

        def find(block: Block) -> Any:
            arrays = store.load(f"{kept}{block.number}") if store else None
            self.resumed += arrays is not None
            return arrays

        def work(blocks: Iterator[Block]) -> Generator[tuple[Block, Value], None, None]:
            tasks = map(task_of, blocks)
            with closing(completed(self.executor, function, tasks, self.settings)) as ended:
                for task, value in ended:
                    if store:
                        store.save(f"{kept}{task.block.number}", cast(Arrays, value))
                    yield task.block, value

        def end(block: Block, value: Value) -> None:
            if put is None:
                results[block.number] = value
            else:
                put(block, value)
            self._advance(steps)  # may raise: the result is stored

        run_pieces(self.blocks, find, work, end)
        return [results[number] for number in sorted(results)]

    def _begin(self, stage: str, total: int) -> None:
        self.row = replace(self.row, status=stage)
        self.done, self.total = 0, total
        self._tell()

    def _advance(self, steps: int) -> None:
        self.done += steps
        self._tell()

    def _tell(self, steps: int = 0) -> None:
        """Tell what is done, with some steps of the current block, and stop if that is asked."""
        if self.progress:
            self.progress(self.done + steps, self.total, self.row)
        if self.interrupted is not None and self.interrupted():
            raise KeyboardInterrupt


FIGURES_TOLERANCE = 1e-5
"""Largest relative difference of the figures of an image on two processors, which sum numbers that
differ in the last bits of single precision."""


def _stored_figures(checkpoint: Checkpoint, figures: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the figures of the first call, so that a run can be continued on any processor.

    Raises
    ------
    ValueError
        If the checkpoint belongs to another image.
    """
    stored = checkpoint.load("survey")
    if stored is None:
        checkpoint.save("survey", {"figures": figures})
        return figures
    first: NDArray[np.float64] = stored["figures"]
    tolerances = FIGURES_TOLERANCE, FIGURES_TOLERANCE * first.max()
    if first.shape != figures.shape or not np.allclose(first, figures, *tolerances):
        raise ValueError(
            f"{checkpoint.folder}: holds an interrupted run of another image; "
            "delete the folder to start again"
        )
    return first

"""The rounds of a fit by blocks: survey, placement, fit, and the error that is left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..backend.executor import Executor
from ..fitting.optimizers.schedule import MIN_PHASE_RATIO
from ..fitting.options import FitOptions
from ..gaussian.file import SetData
from ..storage.checkpoint import Checkpoint
from .block import FitTask, PlaceTask, Settings, fit_block, place, survey
from .draw import compare, compare_tasks
from .grid import PHASES, Block, deal
from .place import OldSet
from .sets import BlockSets
from .source import Source, Window

Progress = Callable[[int, int, dict[str, Any]], None]


class Run:
    """One call of `eigengs_dr.fit_large`.

    Parameters
    ----------
    image : Source
    blocks : list of Block
    options : FitOptions
        With the number of Gaussians.
    executor : Executor
    checkpoint : Checkpoint, optional
        Where blocks that are done wait for the end of the run.
    progress : callable, optional
        See `eigengs_dr.fit_large`.
    pressed : callable, optional
        ``pressed()``: whether the run shall end; None on a cluster.

    Attributes
    ----------
    resumed : int
        Number of blocks, of all rounds, that an earlier call had fitted.
    """

    def __init__(
        self,
        image: Source,
        blocks: list[Block],
        options: FitOptions,
        executor: Executor,
        checkpoint: Checkpoint | None = None,
        progress: Progress | None = None,
        pressed: Callable[[], bool] | None = None,
    ) -> None:
        assert options.gaussians is not None
        self.image, self.blocks, self.options, self.executor = image, blocks, options, executor
        self.checkpoint, self.progress, self.pressed = checkpoint, progress, pressed
        spacing = (image.width * image.height / options.gaussians) ** 0.5
        self.settings = Settings(options, spacing)
        self.resumed = self.steps_done = self.blocks_done = 0

    def fit(self) -> SetData:
        """Place and fit all Gaussians; a long fit places them again where error was left."""
        mass = self._survey()
        steps, first = self.options.iterations, self.options.method.schedule.redistribute_after
        old = None
        if steps >= MIN_PHASE_RATIO * first:
            old, mass = self._find_density(self._place(mass), first)
            steps -= first
        sets = self._fit_blocks(self._place(mass, old), steps)
        background = np.array(self.settings.background, np.float32)
        return SetData(
            sets.arrays | {"background": background},
            (self.image.width, self.image.height),
            self.options.color,
            self.options.cutoff,
        )

    def measure(self, data: SetData) -> tuple[float, float]:
        """Return the sums of the squared errors for psnr_ycbcr and psnr_rgb."""
        tasks = compare_tasks(self.image, data, self.blocks, self.options.backend)
        sums = {b.number: value for b, value in self._map(compare, tasks, self.blocks)}
        ycbcr, rgb = np.sum([value for _, value in sorted(sums.items())], axis=0).tolist()
        return ycbcr, rgb

    def _survey(self) -> NDArray[np.float64]:
        """Return the masses of all blocks, and set the background: the mean of the image."""
        tasks = (PlaceTask(self._window(block), block) for block in self.blocks)
        found = {b.number: value for b, value in self._map(survey, tasks, self.blocks)}
        figures = np.array([[value.mass, *value.total] for _, value in sorted(found.items())])
        mean = figures[:, 1:].sum(axis=0) / (self.image.width * self.image.height)
        self.settings = replace(self.settings, background=tuple(mean.tolist()))
        if self.checkpoint is not None:
            _check_unchanged(self.checkpoint, figures)
        return figures[:, 0]

    def _place(self, mass: NDArray[np.float64], old: BlockSets | None = None) -> BlockSets:
        """Deal the Gaussians to the blocks by their masses, and place them."""
        assert self.options.gaussians is not None
        pixels = np.array([block.pixels for block in self.blocks])
        counts = deal(mass, pixels, self.options.gaussians)
        placed = BlockSets(self.blocks, counts, ("mean", "factor"))

        def tasks() -> Iterator[PlaceTask]:
            for block, count in zip(self.blocks, counts.tolist(), strict=True):
                seen = None
                if old is not None:
                    arrays, _ = old.in_window(block)
                    seen = OldSet(arrays["mean"], arrays["ratio"][:, 0])
                yield PlaceTask(self._window(block), block, count, seen)

        for block, (mean, factor) in self._map(place, tasks(), self.blocks):
            placed.put(block, {"mean": mean, "factor": factor})
        return placed

    def _find_density(self, placed: BlockSets, steps: int) -> tuple[BlockSets, NDArray[np.float64]]:
        """Fit all blocks for some steps; return means, ratios and masses of the wanted density."""
        old = BlockSets(self.blocks, placed.counts(), ("mean", "ratio"))
        mass = np.empty(len(self.blocks))

        # Errors hardly differ between both sides of a border, so that blocks need no phases.
        tasks = partial(self._task, placed, None, steps)
        for block, found in self._fitted("density", self.blocks, tasks, steps):
            mass[block.number] = found["mass"][0]
            old.put(block, found)
        return old, mass

    def _fit_blocks(self, placed: BlockSets, steps: int) -> BlockSets:
        """Fit all blocks, phase by phase."""
        names, options = ("mean", "factor", "color"), self.options
        sets = BlockSets(self.blocks, placed.counts(), names, self.image.channels, options.cutoff)
        tasks = partial(self._task, placed, sets, steps)
        for phase in range(PHASES):
            blocks = [block for block in self.blocks if block.phase == phase]
            for block, found in self._fitted("fit", blocks, tasks, steps):
                sets.put(block, found)
        return sets

    def _task(self, placed: BlockSets, sets: BlockSets | None, steps: int, block: Block) -> FitTask:
        """Return the task of a block beside the sets of earlier phases, or of none for a trial."""
        earlier = [] if sets is None else [b for b in self.blocks if b.phase < block.phase]
        arrays, own = placed.in_window(block, without=earlier)
        fixed = None if sets is None else sets.touching(block, earlier)
        mean, factor = arrays["mean"], arrays["factor"]
        return FitTask(self._window(block), block, mean, factor, own, steps, fixed)

    def _fitted(
        self,
        name: str,
        blocks: list[Block],
        make_task: Callable[[Block], FitTask],
        steps: int,
    ) -> Iterator[tuple[Block, dict[str, NDArray[Any]]]]:
        """Yield blocks that an earlier call has fitted, then fit the others and keep them."""
        waiting = list[Block]()
        for block in blocks:
            found = self.checkpoint.load(f"{name}{block.number}") if self.checkpoint else None
            if found is None:
                waiting.append(block)
                continue
            yield block, found
            self.resumed += 1
            self._advance(steps)
        function: Any = fit_block
        if self.pressed is not None:
            function = partial(fit_block, step_done=self._step_done)
        for block, found in self._map(function, map(make_task, waiting), waiting):
            if self.checkpoint is not None:
                self.checkpoint.save(f"{name}{block.number}", found)
            yield block, found
            self._advance(steps)

    def _map(
        self, function: Any, tasks: Iterator[Any], blocks: list[Block]
    ) -> Iterator[tuple[Block, Any]]:
        """Run the tasks of blocks, and yield the blocks with their results."""
        with closing(self.executor.map(function, tasks, self.settings)) as ended:
            for done in ended:
                if done.lost:
                    raise RuntimeError(f"{self.image.name}: {done.lost}")
                yield blocks[done.index], done.value
                self._stop_if_pressed()

    def _window(self, block: Block) -> Window:
        return self.image.window(block.window_rows, block.window_columns)

    def _advance(self, steps: int) -> None:
        self.steps_done += steps
        self._show(0)

    def _step_done(self, step: int) -> None:
        self._show(step)
        self._stop_if_pressed()

    def _show(self, step: int) -> None:
        if self.progress:
            number = len(self.blocks)
            total = self.options.iterations * number
            self.progress(self.steps_done + step, total, {"blocks": number})

    def _stop_if_pressed(self) -> None:
        if self.pressed is not None and self.pressed():
            raise KeyboardInterrupt


def _check_unchanged(checkpoint: Checkpoint, figures: NDArray[np.float64]) -> None:
    """Raise ValueError if a checkpoint belongs to another image."""
    known = checkpoint.load("survey")
    if known is None:
        checkpoint.save("survey", {"figures": figures})
    elif not np.array_equal(known["figures"], figures):
        raise ValueError(
            f"{checkpoint.folder}: holds an interrupted run of another image; "
            "delete the folder to start again"
        )

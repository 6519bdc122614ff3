"""The stages of a fit by blocks: survey, placement, fit, and measurement of the error."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..backend.executor import Executor, completed
from ..fitting.objective import Extent
from ..gaussian.file import SetData
from ..storage.checkpoint import Checkpoint
from .block import (
    FitTask,
    PlaceTask,
    Settings,
    find_density,
    fit_block,
    measure_extent,
    place,
    rounds,
    survey,
)
from .draw import compare, compare_tasks
from .grid import Arrays, Block, BlockSets, allocate
from .windows import Source, Window

Progress = Callable[[int, int, dict[str, Any]], None]


@dataclass
class Run:
    """One call of `eigengs_dr.fit_large`.

    Attributes
    ----------
    image : Source
    blocks : list of Block
    settings : Settings
        The unit and the background are set by `fit`.
    executor : Executor
    checkpoint : Checkpoint or None
        Storage of finished blocks until the end of the run.
    progress : callable or None
        See `eigengs_dr.fit_large`.
    interrupted : callable or None
        ``interrupted()`` returns whether to end the run; None on a cluster.
    resumed : int
        Number of block fits, over all rounds, taken from an earlier call.
    """

    image: Source
    blocks: list[Block]
    settings: Settings
    executor: Executor
    checkpoint: Checkpoint | None = None
    progress: Progress | None = None
    interrupted: Callable[[], bool] | None = None
    resumed: int = 0
    stage: str = ""
    done: int = 0
    total: int = 0
    extent: Extent = field(init=False)

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
        tasks = compare_tasks(self.image, data, self.blocks, self.settings.options.backend)
        work = partial(compare, affine=self.settings.affine, codes=self.extent.is_of_codes)
        ycbcr, rgb = np.sum(self._in_order(work, tasks), axis=0).tolist()
        return ycbcr, rgb

    def _survey(self) -> NDArray[np.float64]:
        """Return the masses of all blocks; set the unit, and the background to the mean colour.

        The image is read twice, because the unit depends on all blocks.
        """
        self._begin("survey", 2 * len(self.blocks))
        tasks = [PlaceTask(self._window(b), b) for b in self.blocks]
        extents = self._in_order(measure_extent, tasks)
        self.extent = reduce(Extent.joined, extents)
        self.settings = self.settings._replace(affine=self.settings.space.unit(self.extent))
        surveys = self._in_order(survey, tasks)
        figures = np.array([[value.mass, *value.total] for value in surveys])
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
        tasks = (
            PlaceTask(
                self._window(block),
                block,
                int(counts[block.number]),
                None if old is None else old.in_window(block)[0],
            )
            for block in self.blocks
        )
        for block, arrays in self._map(place, tasks):
            placed.put(block, arrays)
        return placed

    def _find_density(self, placed: BlockSets, steps: int) -> tuple[NDArray[np.float64], BlockSets]:
        """Fit all blocks for some steps; return masses, means and ratios of the new density."""
        old = BlockSets(self.blocks, placed.counts, ("mean", "factor", "ratio"))
        mass = np.empty(len(self.blocks))
        task = partial(self._fit_task, sets=placed, steps=steps, part=range(steps))
        self._begin("density", len(self.blocks) * steps)
        for block, arrays in self._fitted("density-", find_density, task, steps):
            mass[block.number] = arrays["mass"][0]
            old.put(block, arrays)
        return mass, old

    def _fit_blocks(self, sets: BlockSets, steps: int) -> BlockSets:
        """Fit all blocks, round by round, from sets without colours."""
        parts = rounds(self.settings.options.method, steps)
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
            for block, arrays in self._fitted(f"fit{number}-", fit_block, task, len(part)):
                fitted.put(block, arrays)
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

    def _fit_task(self, block: Block, sets: BlockSets, steps: int, part: range) -> FitTask:
        """Return the task of a block: its window, the Gaussians in it, and others that touch it."""
        arrays, members = sets.in_window(block)
        fixed = sets.around(block) if "color" in arrays else None
        return FitTask(self._window(block), block, arrays, members, fixed, steps, part)

    def _fitted(
        self, stage: str, function: Any, make_task: Callable[[Block], FitTask], steps: int
    ) -> Iterator[tuple[Block, Arrays]]:
        """Yield the blocks that an earlier call fitted, then fit the others and store them."""
        waiting = []
        for block in self.blocks:
            arrays = self.checkpoint.load(f"{stage}{block.number}") if self.checkpoint else None
            if arrays is None:
                waiting.append(block)
                continue
            self.resumed += 1
            self._advance(steps)
            yield block, arrays
        if self.interrupted is not None:
            function = partial(function, step_done=self._step_done)
        for block, arrays in self._map(function, map(make_task, waiting), steps):
            if self.checkpoint is not None:
                self.checkpoint.save(f"{stage}{block.number}", arrays)
            yield block, arrays

    def _in_order(self, function: Any, tasks: Iterable[Any]) -> list[Any]:
        """Run a task of each block, and return the results in the order of the blocks."""
        results = {block.number: value for block, value in self._map(function, tasks)}
        return [results[block.number] for block in self.blocks]

    def _map(
        self, function: Any, tasks: Iterable[Any], steps: int = 1
    ) -> Iterator[tuple[Block, Any]]:
        """Run tasks of blocks, and yield the blocks with their results."""
        with closing(completed(self.executor, function, tasks, self.settings)) as ended:
            for task, value in ended:
                yield task.block, value
                self._advance(steps)  # `progress` may raise; the caller has stored the result
                self._stop_if_interrupted()

    def _window(self, block: Block) -> Window:
        return self.image.window(block.window_rows, block.window_columns)

    def _begin(self, stage: str, total: int) -> None:
        self.stage, self.done, self.total = stage, 0, total
        self._advance(0)

    def _advance(self, steps: int) -> None:
        self.done += steps
        self._show(0)

    def _step_done(self, step: int) -> None:
        self._show(step)
        self._stop_if_interrupted()

    def _show(self, step: int) -> None:
        if self.progress:
            row = {"stage": self.stage, "blocks": len(self.blocks)}
            self.progress(self.done + step, self.total, row)

    def _stop_if_interrupted(self) -> None:
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

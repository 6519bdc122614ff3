"""The stages of a fit by blocks: survey, placement, fit, and the error that is left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..backend.executor import ClusterError, Executor
from ..fitting.options import FitOptions
from ..fitting.schedule import first_phase
from ..gaussian.file import SetData
from ..storage.checkpoint import Checkpoint
from .block import (
    FitTask,
    OldSet,
    PlaceTask,
    Settings,
    find_density,
    fit_block,
    place,
    rounds,
    survey,
)
from .draw import compare, compare_tasks
from .grid import Arrays, Block, BlockSets, deal
from .windows import Source, Window

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
    interrupted : callable, optional
        ``interrupted()``: whether the run shall end; None on a cluster.

    Attributes
    ----------
    resumed : int
        Number of blocks, of all rounds, that an earlier call had fitted.
    image : Source
        After `fit` with the unit of the fit, in which the set is.
    """

    def __init__(
        self,
        image: Source,
        blocks: list[Block],
        options: FitOptions,
        executor: Executor,
        checkpoint: Checkpoint | None = None,
        progress: Progress | None = None,
        interrupted: Callable[[], bool] | None = None,
    ) -> None:
        assert options.gaussians is not None
        self.image, self.blocks, self.options, self.executor = image, blocks, options, executor
        self.checkpoint, self.progress, self.interrupted = checkpoint, progress, interrupted
        spacing = (image.width * image.height / options.gaussians) ** 0.5
        self.settings = Settings(options, (image.width, image.height), spacing)
        self.resumed, self.stage, self.done, self.total = 0, "", 0, 0

    def fit(self) -> SetData:
        """Place and fit all Gaussians; a long fit places them again where error was left."""
        steps = self.options.iterations
        first = first_phase(self.options.method.schedule, steps)
        sets = self._fit_blocks(self._place_all(first), steps - first)
        background = np.array(self.settings.background, np.float32)
        return SetData(
            sets.arrays | {"background": background},
            (self.image.width, self.image.height),
            self.options.space,
            self.options.cutoff,
        )

    def measure(self, data: SetData) -> tuple[float, float]:
        """Return the sums of the squared errors for psnr_ycbcr and psnr_rgb."""
        self._begin("measure", len(self.blocks))
        tasks = compare_tasks(self.image, data, self.blocks, self.options.backend)
        sums = {b.number: value for b, value in self._map(compare, tasks, self.blocks)}
        ycbcr, rgb = np.sum([value for _, value in sorted(sums.items())], axis=0).tolist()
        return ycbcr, rgb

    def _place_all(self, first: int) -> BlockSets:
        """Place all Gaussians; if there are first steps, again where these leave error."""
        mass, old = self._survey(), None
        if first:
            old, mass = self._find_density(self._place(mass), first)
        return self._place(mass, old)

    def _survey(self) -> NDArray[np.float64]:
        """Return the masses of all blocks, and set the background: the mean of the image.

        Data above the unit of a fit are looked at twice: they are fitted, and so placed, in a unit
        that the whole image says.
        """
        self._begin("survey", len(self.blocks))
        tasks = (PlaceTask(self._window(block), block) for block in self.blocks)
        found = {b.number: value for b, value in self._map(survey, tasks, self.blocks)}
        unit = max(value.unit for value in found.values())
        if unit > 1:
            self.image = replace(self.image, unit=unit)
            return self._survey()
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

        self._begin("place", len(self.blocks))
        for block, (mean, factor) in self._map(place, tasks(), self.blocks):
            placed.put(block, {"mean": mean, "factor": factor})
        return placed

    def _find_density(self, placed: BlockSets, steps: int) -> tuple[BlockSets, NDArray[np.float64]]:
        """Fit all blocks for some steps; return means, ratios and masses of the wanted density."""
        old = BlockSets(self.blocks, placed.counts(), ("mean", "ratio"))
        mass = np.empty(len(self.blocks))

        def make_task(block: Block) -> FitTask:
            return self._fit_task(block, placed, steps, range(steps))

        self._begin("density", len(self.blocks) * steps)
        for block, found in self._fitted("density-", find_density, self.blocks, make_task, steps):
            mass[block.number] = found["mass"][0]
            old.put(block, found)
        return old, mass

    def _fit_blocks(self, sets: BlockSets, steps: int) -> BlockSets:
        """Fit all blocks, round by round, from sets without colours."""
        parts = rounds(self.options.method.schedule, steps)
        names, counts = ("mean", "factor", "color"), sets.counts()
        self._begin("fit", len(self.blocks) * steps)
        first = self._kept_round(len(parts))
        self.resumed += first * len(self.blocks)
        self._advance(len(self.blocks) * parts[first].start)
        for number, part in enumerate(parts[first:], start=first):
            task = partial(self._fit_task, sets=sets, steps=steps, part=part)
            found = BlockSets(self.blocks, counts, names, self.image.channels, self.options.cutoff)
            done = self._fitted(f"fit{number}-", fit_block, self.blocks, task, len(part))
            for block, arrays in done:
                found.put(block, arrays)
            sets = found
            if self.checkpoint is not None:
                self.checkpoint.remove(f"fit{number - 1}-*")
        return sets

    def _kept_round(self, number: int) -> int:
        """Return the last of some rounds of which an earlier call has fitted all blocks, or 0."""
        kept = self.checkpoint
        whole = [
            k
            for k in range(number)
            if kept and all(kept.holds(f"fit{k}-{block.number}") for block in self.blocks)
        ]
        return max(whole, default=0)

    def _fit_task(self, block: Block, sets: BlockSets, steps: int, part: range) -> FitTask:
        """Return the task of a block: its window, all Gaussians in it, and others that touch it."""
        arrays, own = sets.in_window(block)
        mean, factor, color = arrays["mean"], arrays["factor"], arrays.get("color")
        fixed = None if color is None else sets.around(block)
        return FitTask(self._window(block), block, mean, factor, color, own, fixed, steps, part)

    def _fitted(
        self,
        stage: str,
        function: Any,
        parts: list[Block],
        make_task: Callable[[Block], FitTask],
        steps: int,
    ) -> Iterator[tuple[Block, Arrays]]:
        """Yield the parts that an earlier call has fitted, then fit the others and keep them."""
        waiting = list[Block]()
        for part in parts:
            found = self.checkpoint.load(f"{stage}{part.number}") if self.checkpoint else None
            if found is None:
                waiting.append(part)
                continue
            self.resumed += 1
            self._advance(steps)
            yield part, found
        if self.interrupted is not None:
            function = partial(function, step_done=self._step_done)
        for part, found in self._map(function, map(make_task, waiting), waiting, steps):
            if self.checkpoint is not None:
                self.checkpoint.save(f"{stage}{part.number}", found)
            yield part, found

    def _map(
        self, function: Any, tasks: Iterator[Any], parts: list[Block], steps: int = 1
    ) -> Iterator[tuple[Block, Any]]:
        """Run the tasks of some parts, and yield the parts with their results."""
        with closing(self.executor.map(function, tasks, self.settings)) as ended:
            for done in ended:
                if done.lost:
                    raise ClusterError(f"{self.image.name}: {done.lost}")
                yield parts[done.index], done.value
                self._advance(steps)  # the caller has kept the result: `progress` may raise
                self._stop_if_interrupted()

    def _window(self, block: Block) -> Window:
        return self.image.window(block.window_rows, block.window_columns)

    def _begin(self, stage: str, total: int) -> None:
        self.stage, self.done, self.total = stage, 0, total
        self._show(0)

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

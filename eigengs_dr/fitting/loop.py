"""The loop of every fit: controls, steps, and the best set on the way."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace

import drjit as dr
import numpy as np

from ..backend.arrays import types_of
from ..backend.recording import freeze_program, release_later
from ..gaussian.gaussians import Gaussians, like
from ..image.metrics import MAX_PSNR
from .channels import Measured, Row
from .control import act
from .exchange import prune
from .method import Method, Schedule
from .objective import Objective
from .state import State
from .step import listed, started, step_program


def descend(
    objective: Objective,
    method: Method,
    state: State,
    iterations: int,
    key: int = 0,
    part: range | None = None,
) -> Generator[State, None, None]:
    """Yield the state after every step of a descent: the loop of every fit.

    Parameters
    ----------
    objective : Pixels
    method : Method
    state : State
        See `begin`.
    iterations : int
        Number of steps of the whole descent, which sets rates and controls.
    key : int, optional
        All random numbers depend on it and on the step.
    part : range, optional
        The steps to take, by default all.

    Yields
    ------
    State
        Steps run asynchronously: its arrays may not be computed yet. After the last control there
        are as many Gaussians as requested.
    """
    part = range(iterations) if part is None else part
    acts = [(control, frozenset(control.steps(iterations))) for control in method.controls]
    schedule, largest = Schedule(method.rate_factors(iterations), method.warm_up), 0
    kind = np.float32 if objective.image.types.bits == 32 else np.float64
    image = objective.image
    program = step_program(image, method)
    with release_later(state), objective.models() as model_at, freeze_program(program) as take_step:
        for step in part:
            acting = [control for control, steps in acts if step in steps]
            near = objective.near(state.gaussians) if acting else image
            for control in acting:
                state = act(control, state, near, step, iterations, key)
            if state.moving is None:
                state = started(state, method, step, image.grid.images)
            if not state.lists or step >= state.until:
                state = listed(state, image, method, schedule, step, part.stop)
            largest = max(largest, len(state.gaussians))
            rates = image.types.Float(
                [schedule.rate(step, state, rate, kind) for rate in method.rates.values()]
            )
            dr.make_opaque(rates)  # a single rate would be a literal of the program
            moving, moved = take_step(
                largest,
                state.moving,
                state.fixed,
                model_at(state),
                list(state.lists),
                rates,
            )
            state = replace(state, moving=moving, gaussians=moved, squares=None)
            yield state


def last(states: Generator[State, None, None], gaussians: Gaussians) -> Gaussians:
    """Take all steps of a descent; return its last set without derivatives.

    `gaussians` is the set before the first step, for a descent of no steps.
    """
    with closing(states):
        for state in states:
            gaussians = state.gaussians
    return dr.detach(gaussians)


def averaged(states: Generator[State, None, None], first: int) -> Generator[State, None, None]:
    """Yield the states of a descent with the mean of all sets after the first ones.

    With noisy derivatives, the mean is closer to the minimum than any of the sets (Polyak and
    Juditsky, "Acceleration of stochastic approximation by averaging", 1992).
    """
    with closing(states):
        mean: list = []
        for step, state in enumerate(states):
            current = state.gaussians
            moved = [dr.detach(rows) for rows in (current.mean, current.factor, current.color)]
            share = dr.opaque(types_of(current.mean).Float, 1 / max(1, step - first + 1))
            mean = [m + (r - m) * share for m, r in zip(mean or moved, moved, strict=True)]
            dr.eval(mean)
            fields = dict(zip(("mean", "factor", "color"), mean, strict=True))
            yield replace(state, gaussians=replace(current, **fields))


FitProgress = Callable[[int, int, Row], None]

Score = Callable[[Gaussians], list[Measured]]
"""``score(gaussians)`` measures the set of each image of a batch; `Objective.merit` of the row says
which set is the best."""


@dataclass(frozen=True)
class Descent:
    """What a descent makes small, by which method, and who watches it.

    Attributes
    ----------
    objective : Pixels
    method : Method
    score : Score
    key : int
        All random numbers depend on it and on the step.
    progress : callable or None
        Called every 10 steps as ``progress(iteration, iterations, row)`` with the last row of the
        trace, or that of a set with more Gaussians than requested. It may raise `KeyboardInterrupt`
        to end the descent.
    interrupted : callable
        Called before every step; True ends the descent. See
        `eigengs_dr.backend.interrupts.defer_interrupts`.
    """

    objective: Objective
    method: Method
    score: Score
    key: int = 0
    progress: FitProgress | None = None
    interrupted: Callable[[], bool] = lambda: False


@dataclass(frozen=True)
class Refinement:
    """Result of a descent for one image, perhaps of a batch.

    Attributes
    ----------
    gaussians : Gaussians
        The set with the highest `Objective.merit` in the trace; the batch with it, if there is one.
    trace : list of dict
        Rows with the keys iteration, gaussians, seconds, psnr_ycbcr and psnr_rgb.
    iterations : int
        Number of steps.
    stopped : str
        "iterations", "exact" or "interrupted"; see also `eigengs_dr.fitting.search.search_count`.
    row : dict
        The row of the trace that measures the set.
    """

    gaussians: Gaussians
    trace: list[Row] = field(default_factory=list)
    iterations: int = 0
    stopped: str = "iterations"
    row: Row = field(default_factory=Row)

    def judged(
        self, gaussians: Gaussians, row: Row, objective: Objective, count: int
    ) -> Refinement:
        """Return the result with another row of its trace, and the set if it is the best.

        Sets of `count` Gaussians are compared; the best one of another number is none any more.
        """
        self.trace.append(row)
        result = replace(self, iterations=row["iteration"])
        if row["gaussians"] != count:
            return result
        if row.get("psnr_ycbcr", 0.0) > MAX_PSNR and "loss" not in row:
            result = replace(result, stopped="exact")
        if self.row.get("gaussians") == count and objective.merit(row) <= objective.merit(self.row):
            return result
        return replace(result, gaussians=gaussians, row=row)


class Best:
    """The best set of every image of a descent so far.

    Parameters
    ----------
    descent : Descent
    state : State
        The state before the first step.
    iterations : int
    """

    def __init__(self, descent: Descent, state: State, iterations: int) -> None:
        self.descent, self.iterations = descent, iterations
        images = descent.objective.image.grid.images
        self.refinements = [Refinement(state.gaussians) for _ in range(images)]
        marks = {0, 10, 20, 50, iterations}.union(range(100, iterations, 100))  # rows of the trace
        self.marks, self.step, self.state = marks, 0, state
        self.row = Row()
        self.larger: tuple[float, int, Gaussians] | None = None

    def offer(self, step: int, state: State) -> bool:
        """Take the set after a step; return whether all images are exact."""
        self.step, self.state = step, state
        if step in self.marks:
            self.judge(step, state.gaussians)
        progress = self.descent.progress
        if progress and (step in self.marks or step % 10 == 0):
            dr.sync_thread()  # steps run asynchronously; the bar shows finished steps
            progress(step, self.iterations, self.row)
        return all(one.stopped == "exact" for one in self.refinements)

    def judge(self, step: int, gaussians: Gaussians) -> None:
        """Measure a set. A set with more Gaussians than requested is not compared."""
        number, count = len(gaussians) // len(self.refinements), self.state.count
        counted, objective = {"iteration": step, "gaussians": number}, self.descent.objective
        rows = [counted | measured.row for measured in self.descent.score(gaussians)]
        self.row, figure = rows[0], objective.merit(rows[0])
        if number == count:
            self.larger = None
        elif self.larger is None or figure > self.larger[0]:
            self.larger = figure, step, gaussians
        self.refinements = [
            one if one.stopped == "exact" else one.judged(gaussians, row, objective, count)
            for one, row in zip(self.refinements, rows, strict=True)
        ]

    def end_early(self) -> None:
        """Measure the best set with a surplus, and that of the last step, both without it.

        A loss or a judge that ended the descent may end this too: then the rows so far count.
        """
        if len(self.refinements) > 1:
            raise KeyboardInterrupt
        larger = [self.larger] if self.larger else []
        with suppress(KeyboardInterrupt):
            for _, step, gaussians in [*larger, (0.0, self.step, self.state.gaussians)]:
                measured = [row["iteration"] for row in self.refinements[0].trace]
                if step not in measured or len(gaussians) > self.state.count:
                    near = self.descent.objective.near(gaussians)
                    self.judge(step, prune(dr.detach(gaussians), near, self.state.count))
        self.refinements = [
            replace(one, stopped="interrupted", iterations=self.step) for one in self.refinements
        ]


def refine(descent: Descent, state: State, iterations: int) -> list[Refinement]:
    """Descend, and keep the best set of every image.

    Parameters
    ----------
    descent : Descent
    state : State
    iterations : int
        Largest number of steps.

    Returns
    -------
    list of Refinement
        For each image, a set never worse than the start, with as many Gaussians as requested. After
        an interrupt, the last row of the trace measures the last step.

    Raises
    ------
    KeyboardInterrupt
        If the refinement of a batch is interrupted.
    """
    best, method = Best(descent, state, iterations), descent.method
    try:
        ended = best.offer(0, state)
        states = descend(descent.objective, method, state, iterations, descent.key)
        if method.average:
            states = averaged(states, round((1 - method.average) * iterations))
        with closing(states):
            while not (ended or descent.interrupted()) and best.step < iterations:
                ended = best.offer(best.step + 1, next(states))
        stopped = descent.interrupted()
    except KeyboardInterrupt:
        stopped = True
    if stopped:
        best.end_early()
    return best.refinements


def split(batch: Gaussians) -> list[Gaussians]:
    """Return the sets of all images of a batch."""
    if dr.width(batch.background[0]) == 1:
        return [batch]
    backgrounds = np.stack([row.numpy() for row in batch.background], axis=1)
    parts = (
        np.split(np.stack([row.numpy() for row in getattr(batch, name)], axis=1), len(backgrounds))
        for name in ("mean", "factor", "color")
    )
    return [like(batch, *arrays) for arrays in zip(*parts, backgrounds, strict=True)]


def sets_of(refinements: Sequence[Refinement]) -> list[Gaussians]:
    """Return the best set of each image of a batch."""
    batches = {id(one.gaussians): one.gaussians for one in refinements}
    sets = {name: split(dr.detach(batch)) for name, batch in batches.items()}
    return [sets[id(one.gaussians)][k] for k, one in enumerate(refinements)]

"""A fit of a loss without an image: texels, then Gaussians."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.types import Float
from ..gaussian.gaussians import Gaussians
from .coarse import Coarse, texel_sums
from .loop import Descent, FitProgress, Refinement, descend, last, refine
from .loss import LossObjective
from .measure import Measured, Row
from .method import DEFAULT
from .objective import Pixels
from .place import Adaptive
from .problem import Problem
from .search import search_count
from .state import begin

PIXELS_PER_GAUSSIAN = 4
"""Pixels of the picture per Gaussian, if nothing indicates how many the scene needs. With 16, a fit
loses detail that photos show, and takes hardly less time."""

SEEN_PER_GAUSSIAN = 3
"""Pixels that a loss looks at, per Gaussian, if it says their number: with two photos of 256x256
pixels of a painting of 1024x1024 texels, one for 24 texels is 0.3 dB better than one for 4, and its
texture 1.1 dB."""

STEPS_PER_TEXEL = 8
"""Steps of a fit of the texels' picture for each texel of a Gaussian: Gaussians of 4 texels show it
after 30 steps, and those of 64 need 150."""


@dataclass
class Watch:
    """Who watches a fit: its clock, its bar, and what ends it early.

    Attributes
    ----------
    started : float
        Seconds of `time.perf_counter` at the call of `fit`.
    iterations : int
    progress : callable or None
    interrupted : callable
    stopped : bool
        Whether a function of the user has ended the fit.
    """

    started: float
    iterations: int
    progress: FitProgress | None
    interrupted: Callable[[], bool]
    stopped: bool = False

    @contextmanager
    def may_end(self) -> Iterator[None]:
        """Let a function of the user end the fit by a `KeyboardInterrupt`."""
        try:
            yield
        except KeyboardInterrupt:
            self.stopped = True

    @property
    def seconds(self) -> float:
        """The time since the call of `fit`."""
        return time.perf_counter() - self.started

    def show(self, step: int, row: Row) -> None:
        """Call `progress`, which may end the fit."""
        if self.progress and not self.stopped:
            with self.may_end():
                self.progress(step, self.iterations, row)

    def ended(self) -> bool:
        """Return whether something has ended the fit."""
        return self.stopped or self.interrupted()


def fit_loss(problem: Problem, watch: Watch) -> tuple[Refinement, float]:
    """Descend on a loss from nothing or from a set; also return the seconds before Gaussians move.

    A pyramid of texels takes the first steps, see `Coarse`. Gaussians are fitted to its picture,
    and take the remaining steps, in which a search finds the fewest for a target.
    """
    options, taken, trace = problem.options, 0, list[Row]()
    loss = options.loss
    assert loss is not None
    if problem.start is None:
        place = options.method.place
        coarse = place if isinstance(place, Coarse) else Coarse()
        objective = _descend_texels(problem, coarse, watch)
        taken = objective.calls.step
        with watch.may_end():
            if objective.is_called_by_row:
                value = objective.judge(objective.seen(_rows(objective)))
            else:
                value = objective.calls.recent()
            trace = [{"seconds": watch.seconds, "iteration": taken, "loss": value}]
        start = _start(objective, problem, coarse)
    else:
        start = _set_for(problem)
        blank = near(problem, np.zeros(problem.number * problem.size[0] * problem.size[1]))
        objective = near(problem, blank.picture(blank.draw_set(start)[0]).numpy())
    seconds_init = watch.seconds

    def score(gaussians: Gaussians) -> list[Measured]:
        exact = objective.is_called_by_row or objective.calls.step == options.iterations
        row = objective.judged(gaussians) if exact else {"loss": objective.calls.recent()}
        return [Measured({"seconds": watch.seconds, **row}, row.get("margin", math.inf))]

    descent = Descent(
        objective,
        options.method,
        score,
        options.seed,
        watch.progress and (lambda step, steps, row: watch.show(step + taken, row)),
        watch.ended,
    )
    steps = options.iterations - taken
    if options.searches:
        refined = search_count(descent, start, problem.max_count, steps)
    else:
        # The start is the choice of the user.
        method = descent.method.without("densify", "redistribute")
        [refined] = refine(replace(descent, method=method), begin(start), steps)
    if refined.stopped != "interrupted":
        objective.calls.check_use()
    trace += [{**row, "iteration": row["iteration"] + taken} for row in refined.trace]
    return replace(refined, trace=trace, iterations=refined.iterations + taken), seconds_init


def _set_for(problem: Problem) -> Gaussians:
    """Return the set to start from, at the size and the cutoff of the fit."""
    start, cutoff = problem.start, float(problem.options.method.cutoff)
    assert isinstance(start, Gaussians)
    return replace(start.scaled(*problem.size), cutoff=cutoff, maps=()).bounded()


def near(problem: Problem, values: NDArray[np.floating]) -> LossObjective:
    """Return the objective of a loss whose best picture is near these sums, (H * W * C,)."""
    space, (width, height) = problem.space, problem.size
    values = np.asarray(values, np.float32).reshape(height, width, problem.number)
    values = np.maximum(values, 0) if space.is_light else values
    placed = space.placement_image(values)
    pixels = Pixels.of(values, space, problem.types, problem.weight, placed)
    objective = problem.objective(pixels)
    assert isinstance(objective, LossObjective)
    return objective


def _rows(objective: LossObjective) -> Float:
    """Return the picture near which a loss is least, as rows of pixels."""
    assert objective.model.target is not None
    return objective.picture(objective.model.target).array


def _descend_texels(problem: Problem, coarse: Coarse, watch: Watch) -> LossObjective:
    """Return the objective of a loss near the picture of a pyramid of texels."""
    loss = problem.options.loss
    steps = min(coarse.max_steps, round(coarse.share * problem.options.iterations))
    assert loss is not None
    reach = min(channels.space.reach for channels in problem.channels)
    low, high = loss.bounds or (0.0, reach)
    middle = loss.bounds or (0.0, 1.0)
    grey = np.concatenate([c.space.grey(*middle, c.number) for c in problem.channels])
    objective = near(problem, np.tile(grey, problem.size[0] * problem.size[1]))
    states = texel_sums(objective, coarse, steps, grey.tolist(), high - low)
    with closing(states), watch.may_end():
        for step, sums in enumerate(states):  # noqa: B007
            if step % 10 == 0:
                dr.sync_thread()
                watch.show(step, {"seconds": watch.seconds})
            if watch.ended():
                break
    return replace(near(problem, sums.numpy()), calls=objective.calls)


def _start(objective: LossObjective, problem: Problem, coarse: Coarse) -> Gaussians:
    """Fit Gaussians to the image of an objective."""
    options, image, loss = problem.options, objective.image(), objective.loss
    pixels = problem.size[0] * problem.size[1]
    method = replace(DEFAULT, place=options.method.place, cutoff=options.method.cutoff)
    if not isinstance(method.place, Adaptive):  # the choice of a placement is not undone
        method = method.without("densify", "redistribute")
    count = pixels // PIXELS_PER_GAUSSIAN
    if loss.pixels is not None:
        count = min(count, loss.pixels // SEEN_PER_GAUSSIAN)
    start = method.place_and_solve(image, options.count or max(1, count), options.seed)
    steps = min(coarse.fit_steps, STEPS_PER_TEXEL * pixels // len(start))
    return last(descend(image, method, begin(start), steps, options.seed), start)

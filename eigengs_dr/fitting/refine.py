"""Refinement: a descent that records a trace and keeps the best set."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..gaussian.gaussians import Gaussians
from ..image.metrics import MAX_PSNR
from .density_control import prune
from .descent import FitProblem, run
from .measure import Row, measure
from .schedule import Schedule

FitProgress = Callable[[int, int, Row], None]
Score = Callable[[Gaussians], Row]


class Refinement(NamedTuple):
    """Result of `refine`.

    Attributes
    ----------
    gaussians : Gaussians
        The set with the highest psnr_ycbcr in the trace.
    trace : list of dict
        Rows with the keys iteration, seconds, psnr_ycbcr and psnr_rgb, for sets with as many
        Gaussians as the start.
    iterations : int
        Number of steps.
    stopped : str
        "iterations", "exact" or "interrupted"; see also `eigengs_dr.fitting.search.search_count`.
    row : dict
        The row of the trace that measures the set.
    """

    gaussians: Gaussians
    trace: list[Row]
    iterations: int
    stopped: str
    row: Row


def refine(
    problem: FitProblem,
    image: NDArray[np.float32],
    schedule: Schedule,
    iterations: int,
    *,
    started: float | None = None,
    levels: Sequence[int] = (),
    progress: FitProgress | None = None,
    interrupted: Callable[[], bool] = lambda: False,
    score: Score | None = None,
) -> Refinement:
    """Minimise the squared error over all parameters.

    Parameters
    ----------
    problem : FitProblem
        The start and the target.
    image : ndarray of float32, shape (H, W, 3) or (H, W, 1)
        The image in RGB, or the data, for the trace.
    schedule : Schedule
    iterations : int
        Largest number of steps.
    started : float, optional
        Value of `time.perf_counter()` at which the seconds of the trace start; by default now.
    levels : sequence of int, optional
        Sizes of the prefixes of the set that shall form the image too; see
        `eigengs_dr.fitting.descent.descend`.
    progress : callable, optional
        Called every 10 steps as ``progress(iteration, iterations, row)`` with the last row of the
        trace, or that of a set with more Gaussians than the start. It may raise `KeyboardInterrupt`
        to end the refinement.
    interrupted : callable, optional
        Called before every step; True ends the refinement. See
        `eigengs_dr.backend.interrupts.defer_interrupts`.
    score : callable, optional
        ``score(gaussians)`` returns a row of the trace without its iteration, by default that of
        `measure`. Its psnr_ycbcr decides which set is the best.

    Returns
    -------
    Refinement
        A set never worse than the start, with as many Gaussians. After an interrupt, the last row
        of the trace measures the last step, without the Gaussians that the descent has in addition.
    """
    started = time.perf_counter() if started is None else started
    if score is None:
        score = partial(measure, image=image, started=started)
    marks, trace = trace_steps(iterations), list[Row]()
    best, current, highest = problem.gaussians, problem.gaussians, -math.inf
    stopped, step, latest, row = "iterations", 0, Row(), Row()
    count, larger = len(problem.gaussians), list[tuple[float, int, Gaussians]]()

    def judge(step: int, gaussians: Gaussians) -> None:
        nonlocal best, highest, latest, row
        latest = {"iteration": step, **score(gaussians)}
        figure = latest["psnr_ycbcr"]
        if len(gaussians) > count:  # it does not compare; the best one is kept for an interrupt
            larger[:] = [max([*larger, (figure, step, gaussians)], key=lambda found: found[0])]
            return
        larger.clear()
        trace.append(latest)
        if figure > highest:
            best, highest, row = gaussians, figure, latest

    def after(done: int, gaussians: Gaussians) -> bool:
        nonlocal step, current, stopped
        step, current = done, gaussians
        if step in marks:
            judge(step, current)
        if progress and (step in marks or step % 10 == 0):
            dr.sync_thread()  # steps run asynchronously; the bar shows finished steps
            progress(step, iterations, latest)
        if interrupted():
            return True
        if trace and trace[-1]["psnr_ycbcr"] > MAX_PSNR:
            stopped = "exact"
        return stopped == "exact"

    try:
        run(problem, schedule, iterations, after, levels=levels)
        if interrupted():
            stopped = "interrupted"
    except KeyboardInterrupt:
        stopped = "interrupted"
    if stopped == "interrupted":
        for _, at, found in [*larger, (0.0, step, current)]:
            if at not in [row["iteration"] for row in trace]:
                judge(at, prune(dr.detach(found), problem.target, count, problem.weight))
    return Refinement(dr.detach(best), trace, step, stopped, row)


def trace_steps(iterations: int) -> set[int]:
    """Return the steps with a row in the trace: 0, 10, 20, 50, every 100, and the last step."""
    marks = {0, 10, 20, 50, iterations} | set(range(100, iterations, 100))
    return {m for m in marks if m <= iterations}

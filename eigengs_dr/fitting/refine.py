"""Refinement: a descent with a trace, that keeps the best set and ends where nothing is gained."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..gaussian.gaussians import Gaussians
from ..image.metrics import MAX_PSNR, float_space, psnr
from ..raster.render import picture_of
from .initializers import FitProblem
from .optimizers.descent import descend
from .optimizers.schedule import Schedule

FitProgress = Callable[[int, int, dict[str, Any]], None]


class Refinement(NamedTuple):
    """Result of `refine`.

    Attributes
    ----------
    gaussians : Gaussians
        The best set that a row of the trace saw, by psnr_ycbcr.
    trace : list of dict
        Rows with iteration, seconds, psnr_ycbcr, psnr_rgb.
    iterations : int
        Steps taken.
    stopped : str
        "iterations", "plateau" or "interrupted"; see also `eigengs_dr.fitting.search.search_count`.
    """

    gaussians: Gaussians
    trace: list[dict[str, Any]]
    iterations: int
    stopped: str


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
) -> Refinement:
    """Minimise the squared error over all parameters.

    Parameters
    ----------
    problem : FitProblem
        The start and the aim.
    image : ndarray of float32, shape (H, W, 3) or (H, W, 1)
        The image in RGB, or the data, for the trace.
    schedule : Schedule
    iterations : int
        Largest number of steps.
    started : float, optional
        `time.perf_counter()` from which the seconds of the trace count; now by default.
    levels : sequence of int, optional
        Numbers of Gaussians, from the first, that shall make the image too; see `descend`.
    progress : callable, optional
        ``progress(iteration, iterations, row)`` every 10 steps, with the last row of the trace.
    interrupted : callable, optional
        Asked before every step whether to stop; see
        `eigengs_dr.backend.interrupt.defer_interrupts`.

    Returns
    -------
    Refinement
        Never worse than the start. If it was interrupted, the last row of the trace is of the last
        step. `KeyboardInterrupt` from `progress` ends it too.
    """
    started = time.perf_counter() if started is None else started
    marks, trace = trace_steps(iterations), list[dict[str, Any]]()
    best, current, highest = problem.gaussians, problem.gaussians, -math.inf
    stopped, step = "iterations", 0

    def judge() -> None:
        nonlocal best, highest
        figures = measure(current, image, started, problem.base_image)
        trace.append({"iteration": step, **figures})
        if trace[-1]["psnr_ycbcr"] > highest:
            best, highest = current, trace[-1]["psnr_ycbcr"]

    try:
        with closing(descend(problem, schedule, iterations, levels)) as sets:
            for step, reached in enumerate(sets):
                current = reached
                if step in marks:
                    judge()
                if progress and (step in marks or step % 10 == 0):
                    dr.sync_thread()  # steps run asynchronously; the bar shows finished ones
                    progress(step, iterations, trace[-1])
                if interrupted():
                    break
                if step in marks and _is_plateau(trace, schedule):
                    stopped = "plateau"
                    break
        if interrupted():
            stopped = "interrupted"
    except KeyboardInterrupt:
        stopped = "interrupted"
    if stopped == "interrupted" and step not in marks:
        judge()
    return Refinement(dr.detach(best), trace, step, stopped)


def measure(
    gaussians: Gaussians,
    image: NDArray[np.float32],
    started: float,
    base_image: NDArray[np.float32] | None = None,
) -> dict[str, Any]:
    """Measure a set for a row of a trace: seconds, psnr_ycbcr, psnr_rgb; see `refine`."""
    rendered = picture_of(gaussians)
    if base_image is not None:
        rendered = rendered + base_image
    return {
        "seconds": time.perf_counter() - started,
        "psnr_ycbcr": psnr(rendered, image, space=float_space(gaussians.space)),
        "psnr_rgb": psnr(rendered, image, space="rgb"),
    }


def _is_plateau(trace: list[dict[str, Any]], schedule: Schedule) -> bool:
    """Tell whether the last `patience` steps gained less than `least_gain` decibels."""
    last = trace[-1]
    if last["psnr_ycbcr"] > MAX_PSNR:
        return True
    old = [row for row in trace if row["iteration"] <= last["iteration"] - schedule.patience]
    return bool(old) and not last["psnr_ycbcr"] - old[-1]["psnr_ycbcr"] >= schedule.least_gain


def trace_steps(iterations: int) -> set[int]:
    """Steps after which the trace has a row: 0, 10, 20, 50, 100, then every 100, and the last."""
    marks = {0, 10, 20, 50, iterations} | set(range(100, iterations, 100))
    return {m for m in marks if m <= iterations}

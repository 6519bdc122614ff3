"""Refinement: a descent with a trace, that keeps the best set and ends where nothing is gained."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..gaussian.gaussians import Gaussians
from ..image.metrics import float_space, psnr
from ..raster.render import CUTOFF, picture_of
from .optimizers.descent import Redistribute, descend
from .optimizers.schedule import Schedule

MAX_PSNR = 100.0
"""Decibels above which only rounding is left to fit."""

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
    gaussians: Gaussians,
    target: NDArray[np.float32],
    image: NDArray[np.float32],
    schedule: Schedule,
    iterations: int,
    *,
    cutoff: float = CUTOFF,
    started: float | None = None,
    base_image: NDArray[np.float32] | None = None,
    weight: NDArray[np.float32] | None = None,
    redistribute: Redistribute | None = None,
    levels: Sequence[int] = (),
    progress: FitProgress | None = None,
    interrupted: Callable[[], bool] = lambda: False,
) -> Refinement:
    """Minimise the squared error over all parameters.

    Parameters
    ----------
    gaussians : Gaussians
        Where to start.
    target : ndarray of float32, shape (H, W, C)
        The image in the space of the set, at its native size.
    image : ndarray of float32, shape (H, W, 3) or (H, W, 1)
        The image in RGB, or the data, for the trace.
    schedule : Schedule
    iterations : int
        Most steps to take.
    cutoff : float, optional
        See `eigengs_dr.render`.
    started : float, optional
        `time.perf_counter()` from which the seconds of the trace count; now by default.
    base_image : ndarray of float32, shape (H, W, 3), optional
        What a rendering is base_image to before the trace compares it, RGB: the mean image, where
        `target` lacks it.
    weight : ndarray of float32, shape (H, W, C), optional
        What errors are multiplied by before they are squared.
    redistribute : callable, optional
        See `descend`.
    levels : sequence of int, optional
        Numbers of splats, from the first, that shall make the image too; see `descend`.
    progress : callable, optional
        ``progress(iteration, iterations, row)`` every 10 steps, with the last row of the trace.
    interrupted : callable, optional
        Asked before every step whether to stop; see
        `eigengs_dr.backend.interrupt.defer_interrupts`.

    Returns
    -------
    Refined
        Never worse than the start. `KeyboardInterrupt` from `progress` also ends it with the best.
    """
    started = time.perf_counter() if started is None else started
    marks, trace = trace_steps(iterations), list[dict[str, Any]]()
    best, highest = gaussians, -math.inf
    stopped, step = "iterations", 0
    try:
        sets = descend(
            gaussians, target, schedule, iterations, cutoff, weight, redistribute, levels
        )
        for step, current in enumerate(sets):
            if step not in marks:
                if interrupted():
                    break
                if progress and step % 10 == 0:
                    dr.sync_thread()  # steps run asynchronously; the bar tells what is done
                    progress(step, iterations, trace[-1])
                continue
            row = {"iteration": step, **measure(current, image, started, base_image, cutoff)}
            trace.append(row)
            if row["psnr_ycbcr"] > highest:
                best, highest = current, row["psnr_ycbcr"]
            if progress:
                progress(step, iterations, row)
            if interrupted():
                break
            if _is_plateau(trace, schedule):
                stopped = "plateau"
                break
        if interrupted():
            stopped = "interrupted"
    except KeyboardInterrupt:
        stopped = "interrupted"
    return Refinement(dr.detach(best), trace, step, stopped)


def measure(
    gaussians: Gaussians,
    image: NDArray[np.float32],
    started: float,
    base_image: NDArray[np.float32] | None = None,
    cutoff: float = CUTOFF,
) -> dict[str, Any]:
    """Measure a set for a row of a trace: seconds, psnr_ycbcr, psnr_rgb; see `refine`."""
    rendered = picture_of(gaussians, cutoff=cutoff)
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

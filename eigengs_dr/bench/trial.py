"""One measured descent: pictures on the way, and a clock that stops while they are judged."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..fitting.fit import Fit
from ..fitting.initializers import FitProblem
from ..fitting.optimizers.descent import descend
from ..fitting.optimizers.schedule import MIN_PHASE_RATIO, Schedule
from ..fitting.refine import Refinement
from ..gaussian.file import CUTOFF
from ..gaussian.gaussians import Gaussians
from ..image.metrics import MAX_PSNR, ms_ssim, psnr, ssim
from ..raster.render import picture_of

Image = NDArray[np.float32]

Fitted = TypeVar("Fitted", Fit, Refinement)

ITERATIONS = (0, 10, 100, 500, 1000, 5000, 10000)
"""Where the paper's tables look, and 0 and 10 beside."""


class Moment(NamedTuple):
    """What a descent had come to.

    Attributes
    ----------
    iteration : int
        Steps taken.
    seconds : float
        Since before the start was made, without the time that the observer took.
    gaussians : Gaussians
    picture : ndarray of float32, shape (H, W, 3)
        RGB, not clamped.
    """

    iteration: int
    seconds: float
    gaussians: Gaussians
    picture: Image


def follow(
    begin: Callable[[], FitProblem],
    schedule: Schedule,
    iterations: int,
    marks: Collection[int],
    cutoff: float = CUTOFF,
) -> Iterator[Moment]:
    """Run a descent to its last step and yield what it has come to at some of them.

    Unlike `eigengs_dr.fit` it takes all steps, also where nothing is gained any more, and shows the
    set as it is, not the best so far. What runs between two moments is not counted.

    Parameters
    ----------
    begin : callable
        Makes the start; its time counts.
    schedule : Schedule
    iterations : int
    marks : collection of int
        Steps after which to yield; 0 is the start.
    cutoff : float, optional
    """
    spent, resumed = 0.0, time.perf_counter()
    start = begin()
    sets = descend(
        start.gaussians,
        start.target,
        schedule,
        iterations,
        cutoff,
        start.weight,
        start.redistribute,
    )
    for iteration, current in enumerate(sets):
        if iteration not in marks:
            continue
        dr.eval(current)
        dr.sync_thread()  # steps run asynchronously
        spent += time.perf_counter() - resumed
        picture = picture_of(current, cutoff=cutoff)
        yield Moment(
            iteration,
            spent,
            current,
            picture if start.base_image is None else picture + start.base_image,
        )
        resumed = time.perf_counter()


def warm_up(
    begin: Callable[[], FitProblem], schedule: Schedule, iterations: int, cutoff: float = CUTOFF
) -> None:
    """Compile what a descent of so many steps runs, splats placed anew included.

    Parameters are those of `follow`.
    """
    steps = min(MIN_PHASE_RATIO, iterations)
    list(follow(begin, replace(schedule, redistribute_after=1), steps, (0, steps), cutoff))


def whole(fitted: Fitted) -> Fitted:
    """Return a fit that was not broken off: what is kept on Ctrl-C is no measurement.

    Raises
    ------
    KeyboardInterrupt
        If it was.
    """
    if fitted.stopped == "interrupted":
        raise KeyboardInterrupt
    return fitted


def decibels(picture: Image, image: Image, space: str) -> float:
    """Return a PSNR for a row, in dB and at most `MAX_PSNR`; NaN is left to fits that have failed.

    Parameters are those of `eigengs_dr.psnr`.
    """
    return min(psnr(picture, image, space), MAX_PSNR)


def judged(moment: Moment, image: Image) -> dict[str, Any]:
    """Turn a moment into a row: iteration, seconds, psnr_ycbcr, psnr_rgb, ssim, ms_ssim."""
    return {
        "iteration": moment.iteration,
        "seconds": moment.seconds,
        "psnr_ycbcr": decibels(moment.picture, image, "ycbcr"),
        "psnr_rgb": decibels(moment.picture, image, "rgb"),
        "ssim": ssim(moment.picture, image),
        "ms_ssim": ms_ssim(moment.picture, image),
    }

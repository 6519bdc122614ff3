"""Clocks: a descent that is looked at on its way, and programs that take turns."""

import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

import eigengs_dr as eg
from eigengs_dr.fitting.descent import FitProblem, descend
from eigengs_dr.fitting.options import FitOptions
from eigengs_dr.fitting.schedule import MIN_PHASE_RATIO, Schedule
from eigengs_dr.fitting.start import initialize, mean_picture
from eigengs_dr.image.metrics import MAX_PSNR

Image = NDArray[np.float32]  # RGB, shape (H, W, 3), 1 is white


class Moment(NamedTuple):
    """A descent after some steps: seconds since before its start, RGB that is not clamped."""

    iteration: int
    seconds: float
    gaussians: eg.Gaussians
    picture: Image


def follow(
    begin: Callable[[], FitProblem],
    schedule: Schedule,
    iterations: int,
    marks: Collection[int],
    mean_image: Image | None = None,
) -> Iterator[Moment]:
    """Run a descent to its last step and yield its state after the steps in `marks`.

    It takes all steps, and shows the set as it is, where `eigengs_dr.fit` stops and keeps the best.
    Sets with more Gaussians than the first one, which a descent has on its way, are left out.
    Pictures include `mean_image`. The time of `begin` counts; the clock stops between moments.
    """
    spent, resumed = 0.0, time.perf_counter()
    start = begin()
    for iteration, current in enumerate(descend(start, schedule, iterations)):
        if iteration not in marks or len(current) != len(start.gaussians):
            continue
        dr.eval(current)
        dr.sync_thread()  # steps run asynchronously
        spent += time.perf_counter() - resumed
        picture = eg.picture_of(current)
        yield Moment(iteration, spent, current, picture + (0 if mean_image is None else mean_image))
        resumed = time.perf_counter()


def descent(
    image: Image, iterations: int, marks: Collection[int], **options: Any
) -> Iterator[Moment]:
    """Follow the descent of a fit; `options` are those of `FitOptions`."""
    chosen = FitOptions(**options)
    mean_image = mean_picture(chosen, image.shape[1], image.shape[0])
    begin = partial(initialize, image, chosen)
    return follow(begin, chosen.method.schedule, iterations, marks, mean_image)


def warm_up(image: Image, iterations: int, **options: Any) -> None:
    """Compile the programs of a fit, also programs that place Gaussians anew."""
    chosen, steps = FitOptions(**options), min(MIN_PHASE_RATIO, iterations)
    schedule = replace(chosen.method.schedule, redistribute_after=1)
    list(follow(partial(initialize, image, chosen), schedule, steps, (0, steps)))


def decibels(picture: Image, image: Image, space: str) -> float:
    """Return a PSNR for a row, in dB, at most `MAX_PSNR`; a fit that failed has NaN."""
    return min(eg.psnr(picture, image, space), MAX_PSNR)


def judge(picture: Image, image: Image) -> dict[str, float]:
    """Return psnr_ycbcr, psnr_rgb, ssim and ms_ssim of a picture."""
    found = {f"psnr_{space}": decibels(picture, image, space) for space in ("ycbcr", "rgb")}
    return {**found, "ssim": eg.ssim(picture, image), "ms_ssim": eg.ms_ssim(picture, image)}


def score(moment: Moment, image: Image) -> dict[str, Any]:
    """Turn a moment into figures: iteration, seconds, and those of `judge`."""
    when = {"iteration": moment.iteration, "seconds": moment.seconds}
    return when | judge(moment.picture, image)


def interleaved(
    programs: dict[str, Callable[[], Any]],
    warm_up: int,
    rounds: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, float]:
    """Time programs in turns, one of each a round; return median milliseconds by name."""
    times: dict[str, list[float]] = {name: [] for name in programs}
    for done in range(warm_up + rounds):
        for name, program in programs.items():
            started = time.perf_counter()
            dr.eval(program())
            dr.sync_thread()
            if done >= warm_up:  # the first rounds compile and settle
                times[name].append((time.perf_counter() - started) * 1e3)
        progress(done + 1, warm_up + rounds)
    return {name: float(np.median(ms)) for name, ms in times.items()}

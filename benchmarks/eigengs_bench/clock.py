"""Clocks: fits that are measured on their way, and programs that are timed in turn."""

import time
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from functools import partial
from multiprocessing import get_context
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

import eigengs_dr as eg
from eigengs_dr.image.metrics import MAX_PSNR
from eigengs_dr.paper.eigengs import EIGENGS
from eigengs_dr.paper.gaussianimage import GAUSSIANIMAGE

Image = NDArray[np.float32]  # RGB, shape (H, W, 3), 1 is white

METHODS = {"default": eg.DEFAULT, "gaussianimage": GAUSSIANIMAGE, "eigengs": EIGENGS}
"""The methods that are compared, by name."""

WARM_STEPS = 150
"""Steps of a fit that compiles the programs of the fits to be timed, also those of its controls."""


def warm_up(image: Image, iterations: int, **options: Any) -> None:
    """Fit an image in at most `WARM_STEPS`; `options` are those of `eigengs_dr.fit`."""
    eg.fit(image, iterations=min(WARM_STEPS, iterations), progress=False, **options)


def trace_of(
    image: Image, iterations: int, marks: Collection[int], **options: Any
) -> list[dict[str, Any]]:
    """Fit an image, and return the rows of the trace after the steps in `marks`.

    `options` are those of `eigengs_dr.fit`. Rows of more Gaussians than requested, which a fit
    passes through, are left out. PSNRs are at most `MAX_PSNR`.
    """
    result = eg.fit(image, iterations=iterations, progress=False, **options)
    count = len(result.gaussians)
    rows = [r for r in result.trace if r["iteration"] in marks and r["gaussians"] == count]
    return [{k: min(v, MAX_PSNR) if "psnr" in k else v for k, v in row.items()} for row in rows]


def decibels(picture: Image, image: Image, space: str) -> float:
    """Return a PSNR for a row, in dB, at most `MAX_PSNR`; NaN for a fit that failed."""
    return min(eg.psnr(picture, image, space), MAX_PSNR)


def judge(picture: Image, image: Image) -> dict[str, float]:
    """Return psnr_ycbcr, psnr_rgb, ssim and ms_ssim of a picture."""
    psnr = {f"psnr_{space}": decibels(picture, image, space) for space in ("ycbcr", "rgb")}
    return {**psnr, "ssim": eg.ssim(picture, image), "ms_ssim": eg.ms_ssim(picture, image)}


def interleaved(
    programs: dict[str, Callable[[], Any]],
    warm_up: int,
    rounds: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, float]:
    """Time programs in turn, each once per round; return median milliseconds by name."""
    timers = {name: partial(milliseconds, program) for name, program in programs.items()}
    return _medians(timers, warm_up, rounds, progress)


def interleaved_apart(
    makers: Mapping[str, Callable[[], Callable[[], Any]]],
    warm_up: int,
    rounds: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, float]:
    """Time programs in turn, each made in a process of its own, as Mitsuba is slower beside others.

    Mitsuba traces the textures of every live scene at every rendering, so a scene beside another
    one takes the time of both. Makers are pickled.
    """
    with ExitStack() as stack:
        workers = {
            name: stack.enter_context(ProcessPoolExecutor(1, get_context("spawn")))
            for name in makers
        }
        for name, make in makers.items():
            workers[name].submit(_keep, make).result()
        timers = {name: partial(_time_in, worker) for name, worker in workers.items()}
        return _medians(timers, warm_up, rounds, progress)


def milliseconds(program: Callable[[], Any]) -> float:
    """Return the time of one call, with all that it leaves to be computed."""
    started = time.perf_counter()
    dr.eval(program())
    dr.sync_thread()
    return (time.perf_counter() - started) * 1e3


KEPT: list[Callable[[], Any]] = []
"""The program of a process of `interleaved_apart`."""


def _keep(make: Callable[[], Callable[[], Any]]) -> None:
    KEPT.append(make())


def _time_kept() -> float:
    return milliseconds(KEPT[0])


def _time_in(worker: ProcessPoolExecutor) -> float:
    return worker.submit(_time_kept).result()


def _medians(
    timers: Mapping[str, Callable[[], float]],
    warm_up: int,
    rounds: int,
    progress: Callable[[int, int], None],
) -> dict[str, float]:
    """Call timers in turn, each once per round; return their medians."""
    times: dict[str, list[float]] = {name: [] for name in timers}
    for done in range(warm_up + rounds):
        for name, timer in timers.items():
            taken = timer()
            if done >= warm_up:  # the first rounds compile and settle
                times[name].append(taken)
        progress(done + 1, warm_up + rounds)
    return {name: float(np.median(ms)) for name, ms in times.items()}

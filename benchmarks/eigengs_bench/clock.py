"""Clocks: a descent that is measured on its way, and programs that are timed in turn."""

import time
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

import eigengs_dr as eg
from eigengs_dr.fitting.control import Control, Perturb, Redistribute, Relocate, phase_of
from eigengs_dr.fitting.fit import begin_fit
from eigengs_dr.fitting.loop import descend
from eigengs_dr.fitting.objective import Objective
from eigengs_dr.fitting.options import FitOptions
from eigengs_dr.fitting.place import Adaptive
from eigengs_dr.fitting.problem import problem_of_images
from eigengs_dr.fitting.state import begin
from eigengs_dr.image.metrics import MAX_PSNR
from eigengs_dr.paper.eigengs import EIGENGS
from eigengs_dr.paper.gaussianimage import GAUSSIANIMAGE

Image = NDArray[np.float32]  # RGB, shape (H, W, 3), 1 is white

METHODS = {"default": eg.DEFAULT, "gaussianimage": GAUSSIANIMAGE, "eigengs": EIGENGS}
"""The methods that are compared, by name."""

WARM_STEPS = 10
"""Steps of a fit that compiles the programs of the fits to be timed."""

SOON: dict[str, Control] = {
    control.phase: control
    for control in (Redistribute(after=1), Relocate(every=3), Perturb(every=3))
}
"""Controls by phase that act within `WARM_STEPS`."""


class Moment(NamedTuple):
    """A descent after some steps: seconds with the start, and RGB that is not clamped."""

    iteration: int
    seconds: float
    gaussians: eg.Gaussians
    picture: Image


def descent(
    image: Image, iterations: int, marks: Collection[int], **options: Any
) -> Iterator[Moment]:
    """Run the descent of a fit to its last step, and yield its state after the steps in `marks`.

    `options` are those of `FitOptions`. The start is that of `eigengs_dr.fit`, which does not
    expose the state after each step. All steps are taken, and sets are yielded as they are, where
    `eigengs_dr.fit` stops early and keeps the best. States with more Gaussians than requested,
    which a descent passes through, are left out. The time of the start counts; the clock stops
    between moments.
    """
    spent, resumed = 0.0, time.perf_counter()
    chosen = FitOptions(iterations=iterations, **options)
    problem, method = problem_of_images([image], chosen), chosen.method
    objective, begun, _ = begin_fit(problem)
    base = objective.pictures[0].base
    mean_image = 0.0 if base is None else objective.picture(base).numpy()
    if begun is None:
        begun = method.place_and_solve(objective, problem.first_count, chosen.seed)
    if problem.start is not None or method.place != Adaptive():
        method = method.without("densify", "redistribute")
    state = begin(begun)
    steps = descend(Objective(objective), method, state, iterations, chosen.seed)
    for iteration in range(iterations + 1):
        if iteration:
            state = next(steps)
        if iteration not in marks or state.total != state.count:
            continue
        dr.eval(state.gaussians)
        dr.sync_thread()  # steps run asynchronously
        spent += time.perf_counter() - resumed
        yield Moment(iteration, spent, state.gaussians, eg.picture_of(state.gaussians) + mean_image)
        resumed = time.perf_counter()
    steps.close()


def warm_up(image: Image, iterations: int, **options: Any) -> None:
    """Compile the programs of a fit, also those of its controls."""
    method, steps = options.pop("method", eg.DEFAULT), min(WARM_STEPS, iterations)
    controls = tuple(SOON.get(phase_of(control) or "", control) for control in method.controls)
    soon = replace(method, controls=controls)
    list(descent(image, steps, (0, steps), method=soon, **options))


def decibels(picture: Image, image: Image, space: str) -> float:
    """Return a PSNR for a row, in dB, at most `MAX_PSNR`; NaN for a fit that failed."""
    return min(eg.psnr(picture, image, space), MAX_PSNR)


def judge(picture: Image, image: Image) -> dict[str, float]:
    """Return psnr_ycbcr, psnr_rgb, ssim and ms_ssim of a picture."""
    psnr = {f"psnr_{space}": decibels(picture, image, space) for space in ("ycbcr", "rgb")}
    return {**psnr, "ssim": eg.ssim(picture, image), "ms_ssim": eg.ms_ssim(picture, image)}


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

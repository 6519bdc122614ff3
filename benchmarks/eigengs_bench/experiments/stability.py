"""Hard cases times presets: which stay finite, and end no worse than they or shorter runs were."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import drjit as dr
import numpy as np

from eigengs_bench.experiments.stability_cases import Case
from eigengs_bench.harness.alone import measure_alone, peak_gib
from eigengs_bench.harness.store import Job, Row, Task
from eigengs_bench.harness.tiling import tiling
from eigengs_bench.harness.timing import Image, Moment, decibels, follow
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.fitting.descent import FitProblem
from eigengs_dr.fitting.options import PRESETS, FitOptions
from eigengs_dr.fitting.refine import trace_steps
from eigengs_dr.fitting.solvers.conjugate_gradient import solve
from eigengs_dr.fitting.start import initialize, mean_picture
from eigengs_dr.gaussian.covariance import condition_number
from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.image.color import rgb_to_ycbcr
from eigengs_dr.raster.render import picture_of

FILE = "stability.jsonl"

BASIS = "natural"  # where presets that need a basis start
# Pictures of the case "smooth" that are shown side by side, with gross tiles, faint ones and none:
# presets, and how many times the steps of the case they take.
TILES = (("gaussianimage", 1), ("gaussianimage", 3), ("default", 1))


def run(task: Task, cases: Iterable[Case], presets: Sequence[str]) -> list[Row]:
    """Measure every cell of the matrix, case by case."""
    return task.measure(FILE, jobs(task, cases, presets), "stability")


def jobs(task: Task, cases: Iterable[Case], presets: Sequence[str]) -> Iterator[Job]:
    """Name the cells of the matrix."""
    for case, name in product(cases, presets):
        job = {"case": case.name, "preset": name, "seed": task.seed, "iterations": case.iterations}
        work = partial(measure_cell, case, name, task.seed, task.backend)
        yield job, partial(measure_alone, f"case {case.name!r}", work) if case.alone else work


def tiles_of(task: Task, smooth: Case) -> dict[str, Image]:
    """Fit the case "smooth" for a picture of tiles: pictures by what is said of them."""
    image, shown = smooth.image(), {}
    for done, (name, times) in enumerate(TILES):
        task.progress("tiles", done, len(TILES))
        longer = smooth._replace(iterations=times * smooth.iterations)
        last = moments(longer, image, name, task.seed, task.backend)[-1]
        shown[f"{name}, {last.iteration:,} steps"] = last.picture
    return shown


def measure_cell(case: Case, preset: str, seed: int, backend: str | None) -> Row:
    """Run a case by a preset and score it: one cell.

    "needs", alone, says what a preset lacks. Else "finite" is true if all parameters and pixels are
    finite at all marks of `trace_steps`; start, end and half are PSNRs of the first and of the last
    moment and of the last set in half precision, drop is the loss from the best moment to the last;
    "condition" is the highest of a covariance, "peak_gib" the memory of a case in its own process,
    "shorter_ycbcr" the PSNR at the end of a run of the shorter number of steps of the case.
    """
    image = case.image()
    most = image.shape[0] * image.shape[1]
    encodes = PRESETS[preset].mean == "dense" and case.place is None
    if encodes and len(EigenGS.load(BASIS, backend).gaussians) > most:
        return {"needs": f"a basis with at most {most} Gaussians"}
    followed = moments(case, image, preset, seed, backend)
    memory = {"peak_gib": peak_gib()} if case.alone else {}  # before the judgement takes its own
    row = {**_score(followed, image), **memory}
    if case.shorter:
        shorter = moments(case._replace(iterations=case.shorter), image, preset, seed, backend)
        row["shorter_ycbcr"] = decibels(shorter[-1].picture, image, "ycbcr")
    return row


def moments(
    case: Case, image: Image, preset: str, seed: int, backend: str | None = None
) -> list[Moment]:
    """Follow the descent of a preset on the image of a case, at the marks of `trace_steps`."""
    method = PRESETS[preset]
    rates = {name: case.rates * rate for name, rate in method.schedule.rates.items()}
    schedule = replace(method.schedule, rates=rates)
    start = partial(_start, case, image, preset, seed, backend)
    mean_image = None
    if case.place is None:
        options = _options(case, preset, seed, backend)
        mean_image = mean_picture(options, image.shape[1], image.shape[0])
    marks = trace_steps(case.iterations)
    return list(follow(start, schedule, case.iterations, marks, mean_image))


def _options(case: Case, preset: str, seed: int, backend: str | None) -> FitOptions:
    """Return the options of a preset without the shapes of a case."""
    encodes = PRESETS[preset].mean == "dense"
    model, count = (EigenGS.load(BASIS, backend), None) if encodes else (None, case.gaussians)
    return FitOptions(gaussians=count, start=model, preset=preset, seed=seed, backend=backend)


def _start(case: Case, image: Image, preset: str, seed: int, backend: str | None) -> FitProblem:
    """Start as the preset does, or in its way from the shapes of the case."""
    method = PRESETS[preset]
    if case.place is None:
        return initialize(image, _options(case, preset, seed, backend))
    target, generator = rgb_to_ycbcr(image), np.random.default_rng(seed)
    mean, factor = case.place(image, case.gaussians, generator)
    size, shape = (image.shape[1], image.shape[0]), (case.gaussians, 3)
    colors = np.zeros(shape) if method.solves else generator.uniform(0, 1, shape)
    start = Gaussians.from_arrays(mean, factor, colors, size=size, backend=backend).bounded()
    return FitProblem(solve(start, target).gaussians if method.solves else start, target)


def _score(followed: list[Moment], image: Image) -> Row:
    first, last = followed[0], followed[-1]
    arrays = [moment.gaussians.to_arrays() for moment in followed]
    finite = [np.isfinite(moment.picture).all() for moment in followed]
    finite += [np.isfinite(values).all() for kept in arrays for values in kept.values()]
    # What a descent adds to its set, the dense mean, is not stored with it.
    added = last.picture - picture_of(last.gaussians)
    half = picture_of(_round_to_half(last.gaussians)) + added
    row: Row = {
        "finite": all(finite),
        "condition": max(float(condition_number(kept["factor"]).max()) for kept in arrays),
        "tiling": tiling(last.picture, image),
        "gaussians": len(first.gaussians),
        "seconds": last.seconds,
    }
    for space in ("ycbcr", "rgb"):
        # Above EXACT there is rounding only: no drop. NaN stays.
        seen = [decibels(m.picture, image, space) for m in followed]
        row[f"start_{space}"], row[f"end_{space}"] = float(seen[0]), float(seen[-1])
        row[f"drop_{space}"] = float(np.max(seen) - seen[-1])
        row[f"half_{space}"] = decibels(half, image, space)
    return row


def _round_to_half(gaussians: Gaussians) -> Gaussians:

    def half(name: str) -> Any:
        values = getattr(gaussians, name)
        return type(values)(dr.float16_array_t(type(values))(values))

    names = ("mean", "factor", "color", "background")
    return replace(gaussians, **{name: half(name) for name in names})

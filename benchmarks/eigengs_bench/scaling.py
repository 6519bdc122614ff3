"""What size costs: seconds and memory of a fit over pixels, Gaussians and threads.

The row of a descent has place_seconds and solve_seconds, step_ms (median of steps on their own,
most of which build no lists) and mean_ms (of steps in a row, with lists), and peak_gib, the memory
of its process with the interpreter and its libraries. The row of whole fits has images_per_second.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple

import drjit as dr
import numpy as np

import eigengs_dr as eg
from eigengs_bench.clock import Image
from eigengs_bench.rows import Job, Row, Task, alone, peak_gib
from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.descent import FitProblem, descend
from eigengs_dr.fitting.options import PRESETS
from eigengs_dr.fitting.placement.adaptive import place_adaptive
from eigengs_dr.fitting.solvers.conjugate_gradient import solve
from eigengs_dr.image.color import rgb_to_ycbcr
from eigengs_dr.image.resize import center_crop

if TYPE_CHECKING:  # the processes that are measured load neither pandas nor matplotlib
    import pandas as pd
    from matplotlib.figure import Figure

    from eigengs_bench import report as fr

# The mosaic: the middles of photos as squares of as many pixels a side, in turns and turned.
PHOTOS, CELL = ("astronaut", "chelsea", "coffee", "motorcycle", "rocket"), 256
DENSITY = 0.0763  # Gaussians a pixel where the number of pixels varies: 5,000 on 256x256
WARM_UP = 8  # steps that compile programs and settle
# Small images take more steps, up to as many times: about as many pixels in all.
MORE_STEPS, PIXELS_IN_ALL = 4, 1 << 27
FIT_STEPS, FIT_SECONDS = 100, 4.0  # of each whole fit, and of all fits of a size at least

# Sizes by the part that measures them: width, height, numbers of Gaussians.
SIDES = (128, 256, 512, 1024, 2048, 4096, 8192)
SPLATS = {
    (2304, 1536): (100, 300, 1000, 3000, 10_000, 100_000, 1_000_000, 2_000_000),
    (1024, 1024): (100, 1000, 10_000, 100_000, 200_000),
}
THREADED, SMALL = (256, 512, 2048), {64: 300, 128: 1245, 256: 5000}


class Case(NamedTuple):
    """An image of the mosaic, the number of its Gaussians, and the threads, 0 for all cores."""

    width: int
    height: int
    gaussians: int
    threads: int = 0


def run(task: Task, parts: Sequence[str], max_side: int) -> list[Row]:
    """Measure some parts on images of sides up to `max_side`, each size in a new process."""
    return task.measure("scaling", _jobs(task, parts, max_side))


def _jobs(task: Task, parts: Sequence[str], max_side: int) -> Iterator[Job]:
    """Name the measurements; `task.iterations` is the least number of steps behind a mean."""
    for part in parts:
        for case in cases(part, task.backend):
            if max(case.width, case.height) <= max_side:
                most = min(
                    MORE_STEPS * task.iterations, PIXELS_IN_ALL // (case.width * case.height)
                )
                steps = FIT_STEPS if part == "small" else max(task.iterations, most)
                work = measure_fits if part == "small" else measure_descent
                title = f"{case.width}x{case.height}, {case.gaussians:,} Gaussians"
                job = {"part": part, **case._asdict(), "iterations": steps}
                yield job, alone(title, work, case, steps, task.backend)


def cases(part: str, backend: str | None) -> list[Case]:
    """List what a part measures, from small to large."""
    if part == "pixels":
        return [_square(side) for side in SIDES]
    if part == "splats":
        return [Case(*size, count) for size, counts in SPLATS.items() for count in counts]
    if part == "small":
        return [Case(side, side, count) for side, count in SMALL.items()]
    select(backend)
    cores = dr.thread_count()
    counts = sorted({cores, *(1 << k for k in range(cores.bit_length()))})
    return [_square(side)._replace(threads=n) for side in THREADED for n in counts]


def _square(side: int) -> Case:
    return Case(side, side, round(DENSITY * side * side))


def measure_descent(case: Case, steps: int, backend: str | None) -> Row:
    """Place Gaussians, solve for their colours, and take steps of the preset "default"."""
    types = types_in(select(backend))
    if case.threads:
        dr.set_thread_count(case.threads)
    target = rgb_to_ycbcr(mosaic(case.width, case.height))
    _place(target[:CELL, :CELL], 1, types.backend)  # imports
    placed, place_seconds = _place(target, case.gaussians, types.backend)
    solve(placed, target, 1)  # compiles
    started = time.perf_counter()
    start = solve(placed, target).gaussians
    solve_seconds = time.perf_counter() - started
    del placed
    step_ms, mean_ms = time_steps(FitProblem(start, target), steps)
    return {
        "place_seconds": place_seconds,
        "solve_seconds": solve_seconds,
        "step_ms": step_ms,
        "mean_ms": mean_ms,
        "ns_a_pixel": mean_ms * 1e6 / (case.width * case.height),
        "peak_gib": peak_gib(),
    }


def _place(target: Image, count: int, backend: str) -> tuple[eg.Gaussians, float]:
    started = time.perf_counter()
    mean, factor = place_adaptive(target, count, np.random.default_rng(0))
    color, size = np.zeros((count, 3)), (target.shape[1], target.shape[0])
    placed = eg.Gaussians.from_arrays(mean, factor, color, size=size, backend=backend).bounded()
    dr.eval(placed)
    dr.sync_thread()
    return placed, time.perf_counter() - started


def time_steps(problem: FitProblem, steps: int) -> tuple[float, float]:
    """Return milliseconds of a step: the median of single ones, and the mean of `steps` in a row.

    Steps run asynchronously: a mean waits for its last step only, a median for each.
    """
    single = max(5, steps // 3)
    sets = descend(problem, PRESETS["default"].schedule, WARM_UP + steps + single)

    def spend(count: int) -> float:
        started = time.perf_counter()
        for _ in islice(sets, count):
            pass
        dr.sync_thread()
        return 1e3 * (time.perf_counter() - started) / count

    spend(1 + WARM_UP)  # the first set is the start
    mean_ms = spend(steps)
    median_ms = float(np.median([spend(1) for _ in range(single)]))
    sets.close()
    return median_ms, mean_ms


def measure_fits(case: Case, steps: int, backend: str | None, enough: float = FIT_SECONDS) -> Row:
    """Fit images of one size, one after the other."""
    columns = 8
    photos = mosaic(columns * case.width, columns * case.height)
    images = [
        photos[top : top + case.height, left : left + case.width].copy()
        for top in range(0, photos.shape[0], case.height)
        for left in range(0, photos.shape[1], case.width)
    ]
    eg.fit(images[0], case.gaussians, steps, backend=backend)  # compiles
    done, started, seconds = 0, time.perf_counter(), 0.0
    while seconds < enough:
        eg.fit(images[done % len(images)], case.gaussians, steps, backend=backend)
        done, seconds = done + 1, time.perf_counter() - started
    return {"images_per_second": done / seconds, "images": done, "peak_gib": peak_gib()}


def mosaic(width: int, height: int) -> Image:
    """Fill an image with photos of scikit-image, side by side."""
    photos = [center_crop(eg.sample(name), CELL, CELL) for name in PHOTOS]
    image = np.empty((height, width, 3), np.float32)
    for i, top in enumerate(range(0, height, CELL)):
        for j, left in enumerate(range(0, width, CELL)):
            place = image[top : top + CELL, left : left + CELL]
            turned = np.rot90(photos[(i + 2 * j) % len(photos)], i + j)
            place[:] = turned[: place.shape[0], : place.shape[1]]
    return image


# ---------------------------------------------------------------------------------------------
#  Tables and charts
# ---------------------------------------------------------------------------------------------

STYLES = ("o-", "s--", "^:", "D-.")
FIGURES = {
    "step, ms": "step_ms",
    "with lists, ms": "mean_ms",
    "ns a pixel": "ns_a_pixel",
    "placing, s": "place_seconds",
    "colour solve, s": "solve_seconds",
    "peak, GiB": "peak_gib",
}
CAPTIONS = {
    "pixels": "Time and memory over pixels, at equal density of Gaussians",
    "splats": "Time and memory over Gaussians",
    "threads": "Time of a step over threads, and the gain of the mean over one thread",
    "small": f"Small images: fits of {FIT_STEPS} steps, one after the other",
}


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out seconds and memory over pixels, Gaussians and threads: a table and a chart each."""
    from eigengs_bench import report as fr

    frame = fr.frame_of(rows)
    frame["size"] = [f"{w:,}x{h:,}" for w, h in zip(frame.width, frame.height, strict=True)]
    frame["pixels"] = frame.width * frame.height
    frame["Gaussians"] = frame.gaussians.map("{:,}".format)
    frame = frame.sort_values(["pixels", "gaussians", "threads"], kind="stable")
    tables, charts = [], {}
    for name, part in frame.groupby("part", sort=False):
        columns: dict[str, Any] = {k: (column, _one) for k, column in FIGURES.items()}
        by = ["size", "Gaussians"]
        if name == "threads":
            first = part.groupby("size").mean_ms.transform("first")
            part = part.assign(gain=first / part.mean_ms, threads=part.threads.map(str))
            columns, by = {k: columns[k] for k in list(columns)[:2]}, [*by, "threads"]
            columns["gain"] = "gain", _one
        if name == "small":
            rate = "images_per_second", partial(_one, decimals=1)
            columns = {"images a second": rate, "peak, GiB": columns["peak, GiB"]}
        caption = CAPTIONS[str(name)] + (_exponents(part) if name in ("pixels", "splats") else "")
        tables.append(fr.grouped(caption, part, by, columns)._replace(name=str(name)))
        if name in ("pixels", "splats"):
            over = "pixels" if name == "pixels" else "gaussians"
            charts[f"scaling-{name}"] = _chart(part, over)
    return fr.Section(tables, charts)


def _one(values: pd.Series, decimals: int = 2) -> str:
    value = values.iloc[-1]
    return "-" if np.isnan(value) else f"{value:,.{decimals}f}"


def slope(x: Sequence[float], y: Sequence[float]) -> float:
    """Fit the exponent p of ``y ~ x^p`` by least squares of logarithms; NaN for one point."""
    steps, rises = (np.log(np.asarray(values, float)) for values in (x, y))
    steps, rises = steps - steps.mean(), rises - rises.mean()
    return float(steps @ rises / (steps @ steps)) if steps.any() else float("nan")


def _lines(part: pd.DataFrame) -> Iterator[tuple[str, str, pd.DataFrame]]:
    """Yield a name, what varies, and the points of each line of a part."""
    if part.part.iloc[0] == "pixels":
        yield "equal density of Gaussians", "pixels", part
    else:
        for size, some in part.groupby("size", sort=False):
            yield str(size), "gaussians", some


def _exponents(part: pd.DataFrame) -> str:
    found = [f"{name} {slope(some[x], some.mean_ms):.2f}" for name, x, some in _lines(part)]
    return f"; exponents of a step: {', '.join(found)}"


def _chart(part: pd.DataFrame, x: str) -> Figure:
    """Draw time and memory side by side: a line for images of one density, or of one size each."""
    from eigengs_bench import report as fr

    figure = fr.new_figure(10, 4.2)
    axes = figure.subplots(1, 2)
    for (name, _, some), style in zip(_lines(part), STYLES, strict=False):
        axes[0].plot(some[x], some.mean_ms, style, ms=4, label=name)
        axes[1].plot(some[x], some.peak_gib, style, ms=4, label=name)
    for axis, label in zip(axes, ("a step with lists / ms", "peak of memory / GiB"), strict=True):
        fr.label_axes(axis, x, label, "y", xscale="log")
    return figure

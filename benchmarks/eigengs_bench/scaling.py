"""The cost of size: seconds and memory of a fit over pixels and Gaussians, and of small fits.

The row of a fit has start_seconds, of placing Gaussians and solving for their colours; step_ms, the
mean of its steps with the rows of the trace; and peak_gib, the memory of its process with the
interpreter and its libraries. The row of whole fits has images_per_second one by one, and
many_per_second by `fit_many`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import cycle
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import eigengs_dr as eg
from eigengs_bench.clock import WARM_STEPS, Image
from eigengs_bench.rows import Job, Row, Task, alone, peak_gib
from eigengs_dr.image.resize import center_crop

if TYPE_CHECKING:  # the processes that are measured load neither pandas nor matplotlib
    import pandas as pd
    from matplotlib.figure import Figure

    from eigengs_bench import report as fr

# The mosaic: the middles of photos as squares of this side in pixels, alternating and rotated.
PHOTOS, CELL = ("astronaut", "chelsea", "coffee", "motorcycle", "rocket"), 256
DENSITY = 0.0763  # Gaussians per pixel where the number of pixels varies: 5,000 on 256x256
# Small images take up to so many times more steps, for about as many pixels in total.
MORE_STEPS, PIXELS_IN_ALL = 4, 1 << 27
# Steps of whole fits, fewest seconds for all of a size, and images along a side of the mosaic.
FIT_STEPS, FIT_SECONDS, MANY = 100, 4.0, 8


class Case(NamedTuple):
    """An image of the mosaic, and the number of its Gaussians."""

    width: int
    height: int
    gaussians: int


SPLATS = {
    (2304, 1536): (100, 300, 1000, 3000, 10_000, 100_000, 1_000_000, 2_000_000),
    (1024, 1024): (100, 1000, 10_000, 100_000, 200_000),
}
CASES = {  # by the part that measures them, from small to large
    "pixels": [
        Case(side, side, round(DENSITY * side * side))
        for side in (128, 256, 512, 1024, 2048, 4096, 8192)
    ],
    "splats": [Case(*size, count) for size, counts in SPLATS.items() for count in counts],
    "small": [Case(64, 64, 300), Case(128, 128, 1245), Case(256, 256, 5000)],
}


def run(task: Task, parts: Sequence[str], max_side: int) -> list[Row]:
    """Measure some parts on images of sides up to `max_side`, each size in a new process."""
    return task.measure("scaling", _jobs(task, parts, max_side))


def _jobs(task: Task, parts: Sequence[str], max_side: int) -> Iterator[Job]:
    """Name the measurements; `task.iterations` is the least number of steps behind a mean."""
    for part in parts:
        for case in CASES[part]:
            if max(case.width, case.height) <= max_side:
                max_steps = min(
                    MORE_STEPS * task.iterations, PIXELS_IN_ALL // (case.width * case.height)
                )
                steps = FIT_STEPS if part == "small" else max(task.iterations, max_steps)
                work = measure_fits if part == "small" else measure_fit
                title = f"{case.width}x{case.height}, {case.gaussians:,} Gaussians"
                job = {"part": part, **case._asdict(), "iterations": steps}
                yield job, alone(title, work, case, steps, task.backend)


def measure_fit(case: Case, steps: int, backend: str | None) -> Row:
    """Fit an image twice, at first to compile."""
    image = mosaic(case.width, case.height)
    fit = partial(eg.fit, image, case.gaussians, backend=backend, progress=False)
    fit(iterations=min(WARM_STEPS, steps))
    result = fit(iterations=steps)
    first, last = result.trace[0], result.trace[-1]
    step_ms = 1e3 * (last["seconds"] - first["seconds"]) / last["iteration"]
    return {
        "start_seconds": result.seconds_init,
        "step_ms": step_ms,
        "ns_a_pixel": step_ms * 1e6 / (case.width * case.height),
        "peak_gib": peak_gib(),
    }


def measure_fits(case: Case, steps: int, backend: str | None, enough: float = FIT_SECONDS) -> Row:
    """Fit images of one size one by one, and by `fit_many`, for at least `enough` seconds each."""
    photos = mosaic(MANY * case.width, MANY * case.height)
    images = [
        photos[top : top + case.height, left : left + case.width].copy()
        for top in range(0, photos.shape[0], case.height)
        for left in range(0, photos.shape[1], case.width)
    ]
    turn = cycle(images)
    options: Any = {"gaussians": case.gaussians, "iterations": steps, "backend": backend}
    one = _rate(lambda: eg.fit(next(turn), **options), enough)
    many = len(images) * _rate(lambda: eg.fit_many(images, progress=False, **options), enough)
    figures = {"images_per_second": one, "many_per_second": many, "many_ratio": many / one}
    return {**figures, "peak_gib": peak_gib()}


def _rate(call: Callable[[], Any], enough: float) -> float:
    """Return calls per second, without the first one, which compiles."""
    call()
    done, started, seconds = 0, time.perf_counter(), 0.0
    while seconds < enough:
        call()
        done, seconds = done + 1, time.perf_counter() - started
    return done / seconds


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
    "ns per pixel": "ns_a_pixel",
    "start, s": "start_seconds",
    "peak, GiB": "peak_gib",
}
RATES = {
    "`fit`, one by one": "images_per_second",
    "`fit_many`": "many_per_second",
    "the ratio": "many_ratio",
}
CAPTIONS = {
    "pixels": "Time and memory over pixels, at equal density of Gaussians",
    "splats": "Time and memory over Gaussians",
    "small": f"Small images: fits of {FIT_STEPS} steps, images per second",
}


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out seconds and memory over pixels and Gaussians, and images per second."""
    from eigengs_bench import report as fr

    frame = fr.frame_of(rows)
    frame["size"] = [f"{w:,}x{h:,}" for w, h in zip(frame.width, frame.height, strict=True)]
    frame["pixels"] = frame.width * frame.height
    frame["Gaussians"] = frame.gaussians.map("{:,}".format)
    frame = frame.sort_values(["pixels", "gaussians"], kind="stable")
    tables, charts = [], {}
    for name, part in frame.groupby("part", sort=False):
        caption = CAPTIONS[str(name)]
        figures = RATES if name == "small" else FIGURES
        if name != "small":
            x = "pixels" if name == "pixels" else "gaussians"
            line = "equal density of Gaussians" if name == "pixels" else part["size"]
            part = part.assign(line=line)
            charts[f"scaling-{name}"] = _chart(part, x)
        columns = {title: (column, fr.median) for title, column in figures.items()}
        grouped = fr.grouped(caption, part, ["size", "Gaussians"], columns)
        tables.append(grouped._replace(name=str(name)))
    return fr.Section(tables, charts)


def _chart(part: pd.DataFrame, x: str) -> Figure:
    """Draw time and memory side by side: a line for images of one density, or of one size each."""
    from eigengs_bench import report as fr

    figure = fr.new_figure(8, 3.4)
    labels = {"step_ms": "a step / ms", "peak_gib": "peak of memory / GiB"}
    for axis, (column, label) in zip(figure.subplots(1, 2), labels.items(), strict=True):
        for (name, some), style in zip(part.groupby("line", sort=False), STYLES, strict=False):
            axis.plot(some[x], some[column], style, ms=4, label=name)
        fr.label_axes(axis, x, label, "y", xscale="log")
    return figure

"""Speed against accuracy: fits that differ from the default one in one setting at a time.

The row of a variant has "gaussians", their number, and "trace", rows of the trace of
a fit at each number of steps.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import eigengs_dr as eg
from eigengs_bench import report as fr
from eigengs_bench.clock import METHODS, Image, trace_of, warm_up
from eigengs_bench.images import images_of, is_trained, model_for
from eigengs_bench.names import SETS
from eigengs_bench.rows import Job, Row, Task
from eigengs_dr.fitting.place import Grid, Random

# Steps of runs of a method whose rates fall: each number takes its own run.
HORIZONS = (0, 10, 100, 300, 1000)
# Steps after which a run with constant rates is measured: it stands for all shorter ones.
MARKS = (0, 10, 20, 50, 100, 200, 500, 1000)


class Variant(NamedTuple):
    """A fit with one setting, the knob, at another value; the other fields are arguments of `fit`.

    The default fit is the value "default" of the knob "preset".
    """

    knob: str
    value: str | float
    gaussians: int | None = None
    method: eg.Method = eg.DEFAULT
    start: eg.EigenGS | None = None


def run(task: Task, names: Sequence[str]) -> list[Row]:
    """Measure all variants on sets of images."""
    return task.measure("pareto", [job for name in names for job in _jobs(task, name)])


def variants(task: Task, name: str) -> list[Variant]:
    """List the fits that are compared on a set, the default first.

    The basis is that of the set, trained if it is missing, or else the one that ships.
    """
    count, trained = SETS[name].gaussians, is_trained(task, name)
    basis = (
        model_for(task, name, name, 300) if trained else eg.EigenGS.load("natural", task.backend)
    )
    return [
        Variant("preset", "default", count),
        Variant("preset", "gaussianimage", count, METHODS["gaussianimage"]),
        Variant("preset", "eigengs", None, METHODS["eigengs"], basis),
        Variant("init", "grid", count, replace(eg.DEFAULT, place=Grid())),
        Variant("init", "random", count, replace(eg.DEFAULT, place=Random())),
        Variant("init", "eigen", None, start=basis),
        *(
            Variant("solve steps", k, count, replace(eg.DEFAULT, solve_steps=k))
            for k in (0, 2, 5, 30)
        ),
        *(Variant("cutoff", k, count, replace(eg.DEFAULT, cutoff=k)) for k in (2.5, 3.5, 4.0, 5.0)),
        *(Variant("gaussians", round(k * count), round(k * count)) for k in (0.25, 0.5, 2, 4)),
    ]


def _jobs(task: Task, name: str) -> Iterator[Job]:
    for file, image in images_of(task, name):
        about = {"set": name, "image": file, "iterations": task.iterations}
        for fit in variants(task, name):
            yield {**about, "knob": fit.knob, "value": fit.value}, partial(trace, task, fit, image)


def trace(task: Task, fit: Variant, image: Image) -> Row:
    """Run a variant once untimed, then once for every number of steps at which it is judged."""
    iterations = task.iterations
    options = {k: v for k, v in fit._asdict().items() if k not in ("knob", "value")}
    options["backend"] = task.backend
    warm_up(image, iterations, **options)
    falls = fit.method.decay < 1
    marks = sorted({n for n in (HORIZONS if falls else MARKS) if n < iterations} | {iterations})
    runs = [(n, (n,)) for n in marks] if falls else [(iterations, tuple(marks))]
    rows = [row for steps, kept in runs for row in trace_of(image, steps, kept, **options)]
    return {"gaussians": rows[-1]["gaussians"], "trace": rows}


# ---------------------------------------------------------------------------------------------
#  Tables and charts
# ---------------------------------------------------------------------------------------------

FIT = ["set", "image", "knob", "value"]
VARIANTS: dict[str, Any] = {
    "s, start": ("seconds_start", partial(fr.median, decimals=3)),
    "YCbCr, start": ("psnr_ycbcr_start", fr.mean),
    "s": ("seconds", fr.median),
    "YCbCr": ("psnr_ycbcr", fr.mean),
    "RGB": ("psnr_rgb", fr.mean),
    "on front": ("front", "first"),
}
# The description of a knob, its colour and its marker.
KNOBS = {
    "init": ("Where Gaussians start", fr.PINK, "s"),
    "solve steps": ("Steps of the colour solve", fr.ORANGE, "^"),
    "cutoff": ("Cutoff in standard deviations", fr.GREY, "D"),
    "gaussians": ("Number of Gaussians", fr.SKY, "v"),
}


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out what was measured: a table and a chart per set."""
    tables, charts = [], {}
    for name, part in fr.frame_of(rows, "trace").groupby("set", sort=False):
        points = points_of(part)
        tables.append(_variants(str(name), part, points))
        charts[f"pareto-{name}"] = _chart(points, str(name))
    return fr.Section(tables, charts)


def points_of(fits: pd.DataFrame) -> pd.DataFrame:
    """Gather the images of a set: medians of seconds and means of PSNRs, NaN where a fit failed.

    "front" is true where no point is as fast and better.
    """
    groups = fits.groupby(["knob", "value", "iteration", "gaussians"], sort=False)
    points = groups[["psnr_ycbcr"]].agg(lambda values: values.mean(skipna=False))
    points.insert(0, "seconds", groups.seconds.median())
    points = points.assign(images=groups.size()).reset_index()
    pairs = list(zip(points.seconds, points.psnr_ycbcr, strict=True))
    best = front(pairs)
    return points.assign(front=[pair in best for pair in pairs])


def front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Find the points (seconds, PSNR) of which none is as fast and better, or faster and as good.

    They are sorted from the fastest to the best, without duplicates and without NaN.
    """
    best, kept = -math.inf, []
    finite = [point for point in points if not any(map(math.isnan, point))]
    for seconds, reached in sorted(finite, key=lambda point: (point[0], -point[1])):
        if reached > best:
            best = reached
            kept.append((seconds, reached))
    return kept


def _variants(name: str, fits: pd.DataFrame, points: pd.DataFrame) -> fr.Table:
    steps = fits.iteration.max()
    start, ends = fits[fits.iteration == 0], fits[fits.iteration == steps]
    lines = ends.merge(start[[*FIT, "seconds", "psnr_ycbcr"]], on=FIT, suffixes=("", "_start"))
    lines["fit"] = lines.knob + " " + lines.value.map(text_of)
    on = points[points.front].groupby(["knob", "value"], sort=False).iteration
    at = on.agg(lambda values: ", ".join(f"{step:,}" for step in values)).rename("front")
    lines = lines.join(at, on=["knob", "value"]).fillna({"front": fr.MISSING})
    caption = (
        f"{name}, {fr.counted(fits.image)}: seconds and PSNR at the start and after {steps:,} "
        "steps; after how many steps a fit is on the front, where none is as fast and better; "
        "other settings are the default ones"
    )
    return fr.grouped(caption, lines, ["fit"], VARIANTS)._replace(name=name)


def text_of(value: str | float) -> str:
    """Write the value of a knob."""
    return value if isinstance(value, str) else f"{value:,g}"


def _chart(points: pd.DataFrame, name: str) -> Figure:
    """Draw all fits of a set (see `points_of`) and their front."""
    title = f"Settings: {name}, images: {points.images.max()}; up and left is better"
    figure = fr.new_figure(8, 4.6, title)
    axis = figure.subplots()
    for knob, (text, color, marker) in KNOBS.items():
        if len(some := points[points.knob == knob]):
            _plot(axis, some, text, color=color, marker=marker, ls="none", ms=5, alpha=0.75)
    for preset, color in fr.COLORS.items():
        line = points[points.value == preset].sort_values("iteration")
        _plot(axis, line, preset, color=color, marker="o")
    edge = points[points.front].sort_values("seconds")
    _plot(axis, edge, "front: none is better", color=fr.INK, lw=8, alpha=0.18)
    fr.label_axes(axis, "seconds, start included", "PSNR in YCbCr / dB", legend=False)
    fr.legend_beside(figure, axis)
    return figure


def _plot(axis: Axes, points: pd.DataFrame, label: str, **style: Any) -> None:
    axis.plot(points.seconds, points.psnr_ycbcr, label=label, **style)

"""The fewest Gaussians for a PSNR: of fits of fixed numbers, and of the search.

Fits of fixed numbers keep the first places: they neither redistribute nor relocate. The job of such
a fit has "gaussians", and its row the figures of `score`. The job of a search has "target", and its
row gaussians, stopped, iterations, seconds, psnr_ycbcr and psnr_rgb, and fit_seconds and fit_psnr
of a default fit of as many Gaussians.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import cycle

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

import eigengs_dr as eg
from eigengs_bench import report as fr
from eigengs_bench.clock import Image, decibels, follow, score, warm_up
from eigengs_bench.images import images_of
from eigengs_bench.rows import Row, Task
from eigengs_dr.fitting.descent import FitProblem
from eigengs_dr.fitting.options import FitOptions, max_gaussians_for
from eigengs_dr.fitting.schedule import MIN_PHASE_RATIO
from eigengs_dr.fitting.start import initialize

SPARSEST = 1024  # pixels a Gaussian of the smallest fixed number
STEPS_AN_OCTAVE = 2  # fixed numbers from one to twice as many, at least


def run(task: Task, names: Sequence[str], targets: Sequence[float]) -> list[Row]:
    """Measure sets, image by image; a fit that two targets need is in the rows twice."""
    parts = [
        partial(_measure, task, {"set": name, "image": file}, image, target)
        for name in names
        for file, image in images_of(task, name)
        for target in targets
    ]
    found: list[Row] = []
    for done, part in enumerate(parts):
        task.progress("number", done, len(parts))
        found += part()
    return found


def grid(image: Image) -> list[int]:
    """Fixed numbers of Gaussians: from one for `SPARSEST` pixels to the most of a search."""
    most = max_gaussians_for(image)
    least = min(most, math.ceil(image.shape[0] * image.shape[1] / SPARSEST))
    steps = math.ceil(STEPS_AN_OCTAVE * math.log2(most / least))
    return sorted({round(count) for count in np.geomspace(least, most, steps + 1)})


def bisect(counts: Sequence[int], target: float, fitted: Callable[[int], Row]) -> Iterator[Row]:
    """Fit until two neighbours are known, of which the first misses a target and the second not.

    Or the smallest number, if it reaches the target; or the largest, if it does not.
    """
    low, high = -1, len(counts)
    while high - low > 1:
        middle = (low + high) // 2
        row = fitted(counts[middle])
        yield row
        value = row["psnr_ycbcr"]  # None where a fit has failed
        low, high = (low, middle) if value is not None and value >= target else (middle, high)


def _measure(task: Task, about: Row, image: Image, target: float) -> list[Row]:
    """Return the rows of one image and target: fits of fixed numbers around it, and the search."""
    quiet = task._replace(progress=lambda *_: None)
    about = {**about, "iterations": task.iterations}

    def fitted(count: int) -> Row:
        job = {**about, "gaussians": count}
        return quiet.measure("number", [(job, partial(_fit, task, image, count))])[0]

    job = {**about, "target": float(target)}
    searched = quiet.measure("number", [(job, partial(_search, task, image, target))])
    return [*bisect(grid(image), target, fitted), *searched]


def _fit(task: Task, image: Image, count: int) -> Row:
    options = FitOptions(gaussians=count, backend=task.backend)

    def start() -> FitProblem:
        return initialize(image, options)._replace(control=None)

    warm_up(image, task.iterations, gaussians=count, backend=task.backend)
    (moment,) = follow(start, options.method.schedule, task.iterations, (task.iterations,))
    return score(moment, image)


def _search(task: Task, image: Image, target: float) -> Row:
    search = partial(eg.fit, image, target_psnr=target, target_space="ycbcr", backend=task.backend)
    search(iterations=min(MIN_PHASE_RATIO, task.iterations))  # untimed, to compile
    found = search(iterations=task.iterations)
    count = len(found.gaussians)
    usual = eg.fit(image, count, task.iterations, backend=task.backend)
    return {
        "gaussians": count,
        **{key: getattr(found, key) for key in ("stopped", "iterations", "seconds")},
        **{f"psnr_{space}": decibels(found.image, image, space) for space in ("ycbcr", "rgb")},
        "fit_seconds": usual.seconds,
        "fit_psnr": decibels(usual.image, image, "ycbcr"),
    }


# ---------------------------------------------------------------------------------------------
#  Tables and charts
# ---------------------------------------------------------------------------------------------

# Colours and markers of the targets, in turn.
STYLES = (("#c27c0e", "^"), ("#0b6e99", "o"), ("#8a4f9e", "s"), ("#5a8f3c", "D"))
SAVINGS = {
    "fixed": ("least", partial(fr.median, decimals=0)),
    "found": ("enough", partial(fr.median, decimals=0)),
    "% fewer": ("saving", partial(fr.median, decimals=0)),
    "range": ("saving", partial(fr.extent, decimals=0)),
    "images": ("saving", lambda values: str(values.count())),
    "% met": ("met", lambda values: f"{100 * values.mean():.0f}"),
    "s": ("seconds", fr.median),
    "over a fit": ("ratio", fr.median),
    "fit, dB": ("fit_psnr", fr.median),
}


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out how many Gaussians a PSNR takes: a table and a chart a set."""
    tables, charts = [], {}
    for name, part in points_of(rows).groupby("set", sort=False):
        caption = (
            f"{name}, {fr.counted(part.image)}: the smallest fixed number of Gaussians for a PSNR "
            "in YCbCr, placed once, and the number that the search finds; seconds of the search, "
            "also over the seconds of a default fit of this number, and the PSNR of this fit"
        )
        part, both = part.assign(PSNR=part.target.map("{:g} dB".format)), part.saving.notna()
        part = part.assign(least=part.fixed.where(both), enough=part.gaussians.where(both))
        tables.append(fr.grouped(caption, part, ["PSNR"], SAVINGS)._replace(name=str(name)))
        charts[f"number-{name}"] = _chart(part, str(name))
    return fr.Section(tables, charts)


def points_of(rows: Sequence[Row]) -> pd.DataFrame:
    """Gather the targets of all images, in the order of the searches.

    "fixed" is the `smallest` number of Gaussians placed once that reaches a target, "gaussians"
    that of the search. "saving" is in per cent, NaN where one of both does not reach the target;
    "ratio" is of the seconds.
    """
    fits = fr.frame_of(row for row in rows if "target" not in row["job"])
    points = fr.frame_of(row for row in rows if "target" in row["job"])
    once = {
        key: dict(zip(part.gaussians, part.psnr_ycbcr, strict=True))
        for key, part in fits.groupby(["set", "image"])
    }
    keys = zip(points.set, points.image, points.target, strict=True)
    points["fixed"] = [fr.smallest(once.get((name, image), {}), goal) for name, image, goal in keys]
    points["met"] = points.stopped == "met"
    points["saving"] = (100 * (1 - points.gaussians / points.fixed)).where(points.met)
    points["ratio"] = points.seconds / points.fit_seconds
    return points


def _chart(points: pd.DataFrame, name: str) -> Figure:
    """Draw an image and a target a point: Gaussians found over the smallest fixed number."""
    figure = fr.new_figure(6.4, 6, f"No more than needed: {name}; below the line is better")
    axis = figure.subplots()
    styles = zip(points.groupby("target", sort=False), cycle(STYLES), strict=False)
    for (target, some), (color, marker) in styles:
        label = f"{target:g} dB, {some.saving.count()} of {fr.counted(some.image)}"
        both = some.dropna(subset="saving")
        axis.plot(both.fixed, both.gaussians, marker, color=color, ms=5, alpha=0.8, label=label)
    axis.axline((100, 100), (1000, 1000), color=fr.INK, lw=1, label="as many")
    x = "smallest fixed number for a PSNR in YCbCr, Gaussians placed once"
    fr.label_axes(axis, x, "Gaussians that the search finds", "xy")
    return figure

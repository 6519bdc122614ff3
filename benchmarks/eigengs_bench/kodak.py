"""The table that the field compares in: fits of the Kodak photos by numbers of Gaussians and steps.

A row has psnr_float, the PSNR in RGB of float pixels clamped to [0, 1], which is the metric of the
published figures; psnr_rgb, of 8-bit pixels; psnr_ycbcr, ms_ssim, and the seconds of the fit. The
seconds count where the job is "timed": nothing else ran on the machine.
"""

from collections.abc import Iterator, Sequence
from functools import cache, partial
from importlib.resources import files
from itertools import cycle, product

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import eigengs_dr as eg
from eigengs_bench import report as fr
from eigengs_bench.clock import Image, decibels
from eigengs_bench.images import images_of
from eigengs_bench.names import SOLVE_STEPS
from eigengs_bench.rows import Job, Row, Task

SET = "kodak"

PUBLISHED = "published_kodak.csv"
KIND = ["iterations", "solve_steps"]
FIT = [*KIND, "image", "gaussians"]
COLUMNS = (
    "Gaussians",
    "method",
    "steps",
    "PSNR, float",
    "PSNR, 8 bits",
    "MS-SSIM",
    "seconds",
    "photos",
    "source",
)
CAPTION = "PSNR in RGB of float pixels clamped to [0, 1], means over the photos"
OTHERS = ("#b5442f", "#c27c0e", "#7a4f9a", "#5a8f3c", "#8a6d3b", "#666666", "#c2549a", "#2f8f83")

# The metric is of RGB. On 9 training photos (5 of scikit-image, 4 of cats) fits in RGB gain 0.06,
# 0.05, 0.13, 0.46 and 0.57 dB in it with 0.0127, 0.0254, 0.076, 0.127 and 0.178 Gaussians a pixel.
COLOR = "rgb"
WARM_UP = 200  # untimed steps on a small image: as many compile all programs of a fit
SMALL, FEW = 64, 100  # pixels of a side, Gaussians


def run(
    task: Task, counts: Sequence[int], steps: Sequence[int], solve_steps: int, timed: bool
) -> list[Row]:
    """Fit the photos by each number of Gaussians, with each number of steps."""
    return task.measure(SET, list(_jobs(task, counts, steps, solve_steps, timed)))


def _jobs(
    task: Task, counts: Sequence[int], steps: Sequence[int], solve_steps: int, timed: bool
) -> Iterator[Job]:
    """Name the fits: all of the first number of steps before the next, photo by photo."""
    photos = images_of(task, SET)

    @cache
    def compile_programs() -> None:
        for _, photo in photos[:1]:
            small = np.ascontiguousarray(photo[:SMALL, :SMALL])
            eg.fit(small, FEW, WARM_UP, space=COLOR, backend=task.backend)

    def work(image: Image, count: int, iterations: int) -> Row:
        compile_programs()
        return _measure(task, image, count, iterations, solve_steps)

    shared: Row = {"set": SET, "space": COLOR, "timed": timed}
    if solve_steps != SOLVE_STEPS:
        shared["solve_steps"] = solve_steps
    for iterations, (file, image), count in product(steps, photos, counts):
        name = {**shared, "image": file, "gaussians": count, "iterations": iterations}
        yield name, partial(work, image, count, iterations)


def _measure(task: Task, image: Image, count: int, iterations: int, solve_steps: int) -> Row:
    shared: Row = {"space": COLOR, "backend": task.backend}
    found = eg.fit(image, count, iterations, solve_steps=solve_steps, **shared)
    return {
        "psnr_float": decibels(np.clip(found.image, 0, 1), image, "data"),
        "psnr_rgb": decibels(found.image, image, "rgb"),
        "psnr_ycbcr": decibels(found.image, image, "ycbcr"),
        "ms_ssim": eg.ms_ssim(found.image, image),
        "seconds": found.seconds,
        "taken": found.iterations,
    }


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out the quality of each number of Gaussians: a table and two charts.

    Seconds are those of timed fits alone.
    """
    usual = {"solve_steps": SOLVE_STEPS}  # rows of fits with the default do not name it
    fits = fr.frame_of([{**row, "job": {**usual, **row["job"]}} for row in rows])
    known = published()
    photos = fits.drop_duplicates(FIT)
    timed = fits[fits.timed]
    caption = f"kodak: {CAPTION}; seconds of fits while nothing else ran (median)"
    lines = [*_our_lines(photos, timed), *_published_lines(known)]
    lines.sort(key=lambda line: line[0])
    shown = [(f"{count:,}", *cells) for count, *cells in lines]
    charts = {"kodak-gaussians": _over_gaussians(photos, known)}
    if len(timed):
        charts["kodak-seconds"] = _over_seconds(timed, known)
    return fr.Section([fr.table(caption, COLUMNS, shown, fits.code)], charts)


def published() -> pd.DataFrame:
    """Read the published figures: a line a method and a number of Gaussians, with its source."""
    return pd.read_csv(str(files("eigengs_bench") / PUBLISHED))


def _our_lines(photos: pd.DataFrame, timed: pd.DataFrame) -> list[tuple]:
    lines = []
    for kind, part in photos.groupby([*KIND, "gaussians"], sort=True):
        steps, depth, count = kind
        clock = timed[(timed[[*KIND, "gaussians"]] == list(kind)).all(axis=1)].seconds
        lines.append(
            (
                count,
                _name(depth),
                f"{steps:,}",
                fr.mean(part.psnr_float, 2),
                fr.mean(part.psnr_rgb, 2),
                fr.mean(part.ms_ssim, 4),
                fr.median(clock, 1) if len(clock) else fr.MISSING,
                str(part.image.nunique()),
                "measured",
            )
        )
    return lines


def _name(depth: int) -> str:
    """Name our method with the steps of its colour solve, if they are not the usual ones."""
    return "default" if depth == SOLVE_STEPS else f"default, solve_steps={depth}"


def _published_lines(known: pd.DataFrame) -> list[tuple]:
    lines = []
    for row in known.itertuples():
        clock = fr.MISSING if pd.isna(row.seconds) else f"{row.seconds:g} ({row.machine})"
        steps = fr.number(row.steps, 0)
        cells = (fr.number(row.psnr_float, 2), fr.MISSING, fr.MISSING, clock, "24", row.source)
        lines.append((row.gaussians, row.method, steps, *cells))
    return lines


def _over_gaussians(photos: pd.DataFrame, known: pd.DataFrame) -> Figure:
    """Draw PSNR over the number of Gaussians: a line a number of steps, a line a method."""
    figure = fr.new_figure(7.5, 5, f"Kodak, {fr.counted(photos.image)}")
    axis = figure.subplots()
    _draw_ours(axis, photos, "gaussians")
    for color, (name, part) in zip(
        cycle(OTHERS), known.groupby("method", sort=False), strict=False
    ):
        axis.plot(part.gaussians, part.psnr_float, "s--", ms=4, color=color, label=name)
    fr.label_axes(axis, "Gaussians", "PSNR in float RGB / dB")
    return figure


def _over_seconds(timed: pd.DataFrame, known: pd.DataFrame) -> Figure:
    """Draw PSNR over the seconds of a fit, with the number of Gaussians beside each point."""
    figure = fr.new_figure(7.5, 5, f"Kodak, {fr.counted(timed.image)} that were timed")
    axis = figure.subplots()
    _draw_ours(axis, timed, "seconds")
    clocked = known.dropna(subset=["seconds"])
    for color, row in zip(cycle(OTHERS), clocked.itertuples(), strict=False):
        label = f"{row.method}, on {row.machine}"
        axis.plot(row.seconds, row.psnr_float, "s", color=color, label=label)
        _name_point(axis, row.gaussians, row.seconds, row.psnr_float)
    fr.label_axes(axis, "seconds of a fit", "PSNR in float RGB / dB")
    return figure


def _draw_ours(axis: Axes, fits: pd.DataFrame, over: str) -> None:
    """Draw the means of our fits over their Gaussians or, with the number at each, seconds."""
    shades = cycle((1.0, 0.6, 0.4, 0.3))
    for ((steps, depth), part), alpha in zip(fits.groupby(KIND), shades, strict=False):
        points = part.groupby("gaussians")
        x, y = points[over].median(), points.psnr_float.mean()
        label = f"{_name(depth)}, {steps:,} steps"
        axis.plot(x, y, "o-", ms=5, color="#0b6e99", alpha=alpha, label=label)
        for count in x.index if over == "seconds" else ():
            _name_point(axis, count, x[count], y[count])


def _name_point(axis: Axes, count: int, x: float, y: float) -> None:
    axis.annotate(f"{count:,}", (x, y), (4, 4), textcoords="offset points", fontsize=8)

"""The usual comparison: fits of the Kodak photos with several numbers of Gaussians and steps.

A row has psnr_float, the PSNR in RGB of float pixels clamped to [0, 1], which is the metric of the
published figures; psnr_rgb, of 8-bit pixels; psnr_ycbcr, ms_ssim, and the seconds of the fit. The
seconds count where the job is "timed": nothing else ran on the machine.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from importlib.resources import files
from itertools import product
from statistics import mode
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

import eigengs_dr as eg
from eigengs_bench import report as fr
from eigengs_bench.clock import Image, decibels, warm_up
from eigengs_bench.images import images_of
from eigengs_bench.names import KODAK_COUNTS, SOLVE_STEPS
from eigengs_bench.rows import Job, Row, Task

SET = "kodak"
LEGIBLE = 18  # points of text that a chart of 9.2 inches shows with 10 pixels on a phone
LABELLED = (5000, 30_000, 70_000)  # numbers of Gaussians that stand beside points

KIND = ["iterations", "solve_steps"]
FIT = [*KIND, "gaussians"]
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
CAPTION = "PSNR in RGB of float pixels clamped to [0, 1]; means of the photos, medians of seconds"
SHOWN = (*KODAK_COUNTS, 100_000, 147_456)  # the last one has as many numbers as the pixels
OTHERS = (fr.RED, fr.ORANGE, fr.PINK, fr.GREEN, fr.GREY, fr.SKY, fr.INK, "#a07c00")
MARKERS = "s^vDPX<>"

# The metric is in RGB. On 9 training photos (5 of scikit-image, 4 of cats) fits in RGB gain 0.06,
# 0.05, 0.13, 0.46 and 0.57 dB with 0.0127, 0.0254, 0.076, 0.127 and 0.178 Gaussians per pixel.
COLOR = "rgb"


def run(
    task: Task, counts: Sequence[int], steps: Sequence[int], solve_steps: int, timed: bool
) -> list[Row]:
    """Fit the photos by each number of Gaussians, with each number of steps."""
    return task.measure(SET, list(_jobs(task, counts, steps, solve_steps, timed)))


def _jobs(
    task: Task, counts: Sequence[int], steps: Sequence[int], solve_steps: int, timed: bool
) -> Iterator[Job]:
    """Name the fits, photo by photo: all with the first number of steps before the next."""
    photos = images_of(task, SET)
    method = replace(eg.DEFAULT, solve_steps=solve_steps)
    options: Row = {"space": COLOR, "method": method, "backend": task.backend}
    warm_up(photos[0][1], max(steps), **options)
    shared: Row = {"set": SET, "space": COLOR, "timed": timed}
    if solve_steps != SOLVE_STEPS:
        shared["solve_steps"] = solve_steps
    for iterations, (file, image), count in product(steps, photos, counts):
        name = {**shared, "image": file, "gaussians": count, "iterations": iterations}
        yield name, partial(_measure, image, count, iterations, options)


def _measure(image: Image, count: int, iterations: int, options: Row) -> Row:
    result = eg.fit(image, count, iterations, **options)
    return {
        "psnr_float": decibels(np.clip(result.image, 0, 1), image, "data"),
        "psnr_rgb": decibels(result.image, image, "rgb"),
        "psnr_ycbcr": decibels(result.image, image, "ycbcr"),
        "ms_ssim": eg.ms_ssim(result.image, image),
        "seconds": result.seconds,
        "taken": result.iterations,
    }


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out the quality for each number of Gaussians: tables and a chart.

    Seconds are those of timed fits alone.
    """
    usual = {"solve_steps": SOLVE_STEPS}  # rows of fits with the default do not name it
    fits = fr.frame_of([{**row, "job": {**usual, **row["job"]}} for row in rows])
    photos, others = fits.drop_duplicates([*FIT, "image"]), published()
    means = photos.groupby(FIT)[["psnr_float", "psnr_rgb", "ms_ssim"]].mean()
    means["seconds"] = fits[fits.timed].groupby(FIT).seconds.median()
    means["photos"] = photos.groupby(FIT).image.nunique()
    ours = means.reset_index().rename(columns={"iterations": "steps"})
    ours["method"], ours["source"] = ours.solve_steps.map(_name), "measured"
    both = pd.concat([ours, others.assign(photos=24)]).sort_values("gaussians", kind="stable")
    both["where"] = (" (" + both.machine + ")").fillna("")
    lines = [
        (
            f"{line.gaussians:,}",
            line.method,
            fr.number(line.steps, 0),
            fr.number(line.psnr_float, 2),
            fr.number(line.psnr_rgb, 2),
            fr.number(line.ms_ssim, 4),
            fr.number(line.seconds, 2) + line.where,
            str(line.photos),
            line.source,
        )
        for line in both.itertuples()
    ]
    table = fr.table(CAPTION, COLUMNS, lines, "all")
    charts = {"kodak-gaussians": _over_gaussians(photos, others)}
    machine = mode(fr.machine_of(row["run"]) for row in rows)  # seconds of two do not compare
    timed = fr.frame_of(row for row in rows if fr.machine_of(row["run"]) == machine)
    # One number of steps alone: curves that were timed in two hours would compare the hours.
    fits = timed[timed.timed & (timed.iterations > 0)]
    if len(fits):
        fewest = fits[fits.iterations == fits.iterations.min()]
        charts["kodak-speed"] = _over_seconds(fewest, others.dropna(subset="seconds"))
    return fr.Section([table, _by_counts(both)], charts, _figures(ours, others))


def _by_counts(both: pd.DataFrame) -> fr.Table:
    """Put the usual numbers of Gaussians side by side: a line for each method and its steps."""
    both = both[both.gaussians.isin(SHOWN)].fillna({"steps": 0})
    both["cell"] = [
        fr.number(line.psnr_float, 2)
        + (f" ({fr.number(line.seconds)} s)" if line.seconds == line.seconds else "")
        for line in both.itertuples()
    ]
    lines = []
    for (method, steps), part in both.groupby(["method", "steps"], sort=False):
        cells = dict(zip(part.gaussians, part.cell, strict=True))
        name = f"{method}, {steps:,.0f} steps" if steps else str(method)
        source = part.source.iloc[0]
        name += "" if source == "measured" else f" ({source})"
        lines.append((name, *(cells.get(count, "") for count in SHOWN)))
    caption = (
        "PSNR in RGB in dB of the Kodak photos by numbers of Gaussians, and median seconds per "
        "photo: default on 2 cores, published methods on their GPU"
    )
    return fr.table(caption, ("method", *(f"{n:,}" for n in SHOWN)), lines, "quality")


def _figures(ours: pd.DataFrame, others: pd.DataFrame) -> dict[str, str]:
    """Write PSNR and seconds of fits of 1,000 steps, and the best published PSNR if any."""
    usual = ours[(ours.steps == 1000) & (ours.solve_steps == SOLVE_STEPS)].set_index("gaussians")
    best = (
        others[~others.method.str.contains("not Gaussians")].groupby("gaussians").psnr_float.max()
    )
    figures = {}
    for count in usual.index:
        figures[f"psnr_{count}"] = f"{fr.number(usual.psnr_float[count])} dB"
        figures[f"seconds_{count}"] = f"{fr.number(usual.seconds[count])} s"
    for count in sorted(set(usual.index) & set(best.index)):
        figures[f"best_{count}"] = f"{fr.number(best[count])} dB"
    return figures


def published() -> pd.DataFrame:
    """Read the published figures: a line per method and number of Gaussians, with its source."""
    return pd.read_csv(str(files("eigengs_bench") / "published_kodak.csv"))


def _name(depth: int) -> str:
    """Name our method with the steps of its colour solve, if they are not the usual ones."""
    return "default" if depth == SOLVE_STEPS else f"default, solve_steps={depth}"


def _over_gaussians(photos: pd.DataFrame, others: pd.DataFrame) -> Figure:
    """Draw PSNR over the number of Gaussians: a line per number of steps, and per method."""
    figure = fr.new_figure(8, 4.6, f"Kodak, {fr.counted(photos.image)}: quality over numbers")
    axis = figure.subplots()
    for (steps, depth), part in photos.groupby(KIND):
        alpha = {0: 0.3, 1000: 1.0}.get(steps, 0.6)
        points, label = part.groupby("gaussians").psnr_float.mean(), _name(depth)
        label += f", {steps:,} steps"
        axis.plot(points, "o-", ms=5, color=fr.BLUE, alpha=alpha, label=label)
    styles = zip(OTHERS, MARKERS, others.groupby("method", sort=False), strict=False)
    for color, marker, (name, part) in styles:
        label = name.partition(" (")[0]
        axis.plot(part.gaussians, part.psnr_float, f"{marker}--", ms=5, color=color, label=label)
    fr.label_axes(axis, "Gaussians", "PSNR in RGB / dB", legend=False)
    fr.legend_beside(figure, axis)
    return figure


def _over_seconds(fits: pd.DataFrame, others: pd.DataFrame) -> Figure:
    """Draw PSNR over seconds, beside published figures, for a front page and for phones.

    Words stand beside points: a legend would take half of the height of a phone.
    """
    figure = fr.new_figure(9.2, 5.4)
    axis = figure.subplots()
    points = fits.groupby("gaussians").agg({"seconds": "median", "psnr_float": "mean"})
    axis.plot(points.seconds, points.psnr_float, "o-", ms=8, color=fr.BLUE)

    def write(words: str, x: float, y: float, color: str, side: str) -> None:
        offset = {"right": (-11, -6), "left": (12, -6), "center": (0, 13)}[side]
        look: Any = {"ha": side, "fontsize": LEGIBLE, "color": color}
        axis.annotate(words, (x, y), offset, textcoords="offset points", **look)

    for count, point in points.iterrows():
        if count in LABELLED:
            write(f"{count:,}", point.seconds, point.psnr_float, fr.BLUE, "right")
    last = points.iloc[-1]
    words = f"eigengs_dr, {points.index[-1]:,} Gaussians"
    write(words, last.seconds, last.psnr_float, fr.BLUE, "right")
    for name, part in others.groupby("method", sort=False):
        method = re.split(r"[ ,]", str(name))[0]
        axis.plot(part.seconds, part.psnr_float, "X", color=fr.RED, ms=13)
        highest = part.loc[part.psnr_float.idxmax()]
        side = "left" if highest.seconds < 5 * last.seconds else "center"  # near the edge
        write(method, highest.seconds, highest.psnr_float, fr.RED, side)
    axis.margins(x=0.08, y=0.1)
    fr.label_axes(axis, "seconds per photo", "PSNR in RGB / dB", legend=False)
    axis.xaxis.set_minor_formatter("")  # the axis is of several decades
    axis.tick_params(labelsize=LEGIBLE)
    axis.set_title(f"{fits.image.nunique()} Kodak photos: 2 cores (blue), GPUs (published)")
    for text in (axis.xaxis.label, axis.yaxis.label, axis.title):
        text.set_fontsize(LEGIBLE)
    return figure

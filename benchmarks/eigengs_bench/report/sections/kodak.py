"""Fits of the Kodak photos beside published figures, from the rows that `kodak` measured."""

from collections.abc import Sequence
from importlib.resources import files
from itertools import cycle

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eigengs_bench.harness.store import Row
from eigengs_bench.names import SOLVE_STEPS
from eigengs_bench.report import frames as fr
from eigengs_bench.report.charts import label_axes, new_figure

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


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out the quality of each number of Gaussians: a table and two charts.

    Seconds are those of timed fits alone.
    """
    usual = {"solve_steps": SOLVE_STEPS}  # rows of fits with the default do not name it
    fits = fr.frame_of([{**row, "job": {**usual, **row["job"]}} for row in rows])
    known = published()
    photos = fits.drop_duplicates(FIT)
    timed = fits[fits.timed]
    caption = f"kodak: {CAPTION}; seconds of fits while nothing else ran (median, middle half)"
    lines = [*_our_lines(photos, timed), *_published_lines(known)]
    lines.sort(key=lambda line: line[0])
    shown = [(f"{count:,}", *cells) for count, *cells in lines]
    charts = {"kodak-gaussians": _over_gaussians(photos, known)}
    if len(timed):
        charts["kodak-seconds"] = _over_seconds(timed, known)
    about = CAPTION + fr.remark(fits.code)
    return fr.Section(
        [fr.table(caption, COLUMNS, shown, fits.code)],
        {name: (about, figure) for name, figure in charts.items()},
    )


def published() -> pd.DataFrame:
    """Read the published figures: a line a method and a number of Gaussians, with its source."""
    return pd.read_csv(str(files("eigengs_bench.report") / PUBLISHED))


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
                fr.quartiles(clock, 1) if len(clock) else fr.MISSING,
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
    figure = new_figure(7.5, 5, f"Kodak, {fr.counted(photos.image)}")
    axis = figure.subplots()
    _draw_ours(axis, photos, "gaussians")
    for color, (name, part) in zip(
        cycle(OTHERS), known.groupby("method", sort=False), strict=False
    ):
        axis.plot(part.gaussians, part.psnr_float, "s--", ms=4, color=color, label=name)
    label_axes(axis, "Gaussians", "PSNR in float RGB / dB")
    return figure


def _over_seconds(timed: pd.DataFrame, known: pd.DataFrame) -> Figure:
    """Draw PSNR over the seconds of a fit, with the number of Gaussians beside each point."""
    figure = new_figure(7.5, 5, f"Kodak, {fr.counted(timed.image)} that were timed")
    axis = figure.subplots()
    _draw_ours(axis, timed, "seconds")
    clocked = known.dropna(subset=["seconds"])
    for color, row in zip(cycle(OTHERS), clocked.itertuples(), strict=False):
        label = f"{row.method}, on {row.machine}"
        axis.plot(row.seconds, row.psnr_float, "s", color=color, label=label)
        _name_point(axis, row.gaussians, row.seconds, row.psnr_float)
    label_axes(axis, "seconds of a fit", "PSNR in float RGB / dB")
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

"""Table, chart and film strips of the posters that `inverse` recovered."""

from __future__ import annotations

import pandas as pd
from matplotlib.figure import Figure

from eigengs_bench.experiments.inverse import GOAL, Result, figures_of
from eigengs_bench.report.charts import new_figure
from eigengs_bench.report.frames import MISSING, Table, number, table
from eigengs_bench.report.strips import Cell, Line, Picture, strip
from eigengs_dr.color import to_coded
from eigengs_dr.resampling import resampled

TITLES = {
    "texels1024": "1,024 x 1,024 texels",
    "texels256": "256 x 256 texels",
    "gaussians": "Gaussians from grey",
    "coefficients": "coefficients",
    "both": "coefficients, then Gaussians",
}

CAPTIONS = {
    "cameras": "three cameras",
    "grazing": "one grazing, blurred camera",
    "hidden": "right half hidden",
    "noise": "noise: 4 samples a pixel",
}

SIDE, GAP = 96, 4
"""Side of a picture in a strip, and white pixels between two, in pixels."""


def results_table(results: dict[str, Result]) -> Table:
    """Lay out the figures of all conditions and methods."""
    figures = pd.DataFrame(figures_of(results))
    lines = [
        (
            f"{row.condition}, {TITLES[row.method]}",
            number(row.psnr_ycbcr),
            number(row.psnr_rgb),
            number(row.seconds),
            number(row.goal_steps, 0).replace(MISSING, "never"),
            number(row.goal_seconds),
            number(row.visible),
            number(row.hidden),
        )
        for row in figures.itertuples()
    ]
    goal = f"to {GOAL:g} dB"
    columns = ("method", "YCbCr", "RGB", "s", f"steps {goal}", f"s {goal}", "visible", "hidden")
    caption = "PSNR / dB of the recovered poster after all steps; of its halves where one is hidden"
    return table(caption, columns, lines)


def results_chart(results: dict[str, Result]) -> Figure:
    """Draw PSNR over steps and over seconds, a column a condition."""
    figure = new_figure(3.2 * len(results), 5.6)
    axes = figure.subplots(2, len(results), squeeze=False, sharey=True)
    for column, (name, result) in zip(axes.T, results.items(), strict=True):
        for method, trace in result.traces.items():
            column[0].plot(trace.steps, trace.psnr_ycbcr, label=TITLES[method])
            # The start, at 0 seconds, has no place on a logarithmic scale.
            column[1].plot(trace.seconds[1:], trace.psnr_ycbcr[1:])
        column[0].set_title(CAPTIONS[name], fontsize=10)
        column[0].set_xscale("symlog", linthresh=1)
        column[0].set_xlabel("steps")
        column[1].set(xscale="log", xlabel="seconds")
        for axis in column:
            axis.grid(alpha=0.3)
    for row in axes:
        row[0].set_ylabel("PSNR (YCbCr) / dB")
    lines = axes[0, 0].get_lines()
    figure.legend(handles=lines, loc="outside lower center", ncols=len(lines), fontsize=9)
    return figure


def film_strip(result: Result) -> Picture:
    """Draw a condition's film strip: the photos, then a row a method, a column a step.

    Returns
    -------
    ndarray of float, shape (H, W, 3)
        RGB; every picture above its PSNR in YCbCr, the truth in a last column.
    """
    height, width = result.photos.shape[:2]
    photos = resampled(to_coded(result.photos.clip(0, 1)), round(SIDE * width / height), SIDE)
    lines = [
        Line("photos", [Cell("", photos[:, k : k + SIDE]) for k in range(0, photos.shape[1], SIDE)])
    ]
    for method, trace in result.traces.items():
        by_step = dict(zip(trace.steps, trace.psnr_ycbcr, strict=True))
        cells = [
            Cell(f"{step}: {by_step[step]:.1f} dB", picture)
            for step, picture in trace.pictures.items()
        ]
        lines.append(Line(TITLES[method], [*cells, Cell("truth", result.truth)]))
    return strip(lines, side=SIDE, gap=GAP)

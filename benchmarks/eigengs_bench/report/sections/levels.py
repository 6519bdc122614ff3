"""PSNR over how many Gaussians of a set are drawn, from the rows that `levels` measured."""

import pandas as pd

from eigengs_bench.report.charts import label_axes, new_figure
from eigengs_bench.report.frames import Section, number, table

LINES = {
    "levels": ("the first of one set, fitted in levels", "o-"),
    "alone": ("a fit of as many", "o--"),
    "sorted": ("the most valuable of one set without levels", "s:"),
}


def summarize(points: pd.DataFrame, name: str) -> Section:
    """Lay out PSNR over the number of Gaussians that are drawn."""
    lines = [
        (f"{row.splats:,}{' *' * row.level}", *(number(row[key], 2) for key in LINES))
        for _, row in points.iterrows()
    ]
    words = ", ".join(words for words, _ in LINES.values())
    caption = f"{name}: PSNR in YCbCr by Gaussians drawn (* a level ends): {words}"
    figure = new_figure(6.4, 4.6, f"Levels of detail: {name}; lines mark where levels end")
    axis = figure.subplots()
    for key, (label, style) in LINES.items():
        axis.plot(points.splats, points[key], style, ms=4, label=label)
    for end in points.splats[points.level]:
        axis.axvline(end, color="#888888", lw=0.6)
    label_axes(axis, "Gaussians drawn", "PSNR in YCbCr / dB")
    return Section([table(caption, ("Gaussians", *LINES), lines)], {"levels": (caption, figure)})

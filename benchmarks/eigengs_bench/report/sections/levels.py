"""PSNR over how many splats of a set are drawn, from the rows that `levels` measured."""

from collections.abc import Sequence

import pandas as pd

from eigengs_bench.harness.store import Row
from eigengs_bench.report.charts import label_axes, new_figure
from eigengs_bench.report.frames import Told, number, table

LINES = {
    "levels": ("the first of one set, fitted in levels", "o-"),
    "alone": ("a fit of as many", "o--"),
    "sorted": ("the most valuable of one set without levels", "s:"),
}


def tell(rows: Sequence[Row], name: str) -> Told:
    """Lay out PSNR over splats that are drawn of an image."""
    points = pd.DataFrame(rows)
    lines = [
        (f"{row['splats']:,}{' *' * row['level']}", *(number(row[key], 2) for key in LINES))
        for row in rows
    ]
    words = ", ".join(words for words, _ in LINES.values())
    caption = f"{name}: PSNR in YCbCr by splats drawn (* a level ends): {words}"
    figure = new_figure(6.4, 4.6, f"Levels of detail: {name}; lines mark where levels end")
    axis = figure.subplots()
    for key, (label, style) in LINES.items():
        axis.plot(points.splats, points[key], style, ms=4, label=label)
    for end in points.splats[points.level]:
        axis.axvline(end, color="#888888", lw=0.6)
    label_axes(axis, "Gaussians drawn", "PSNR in YCbCr / dB", subs=(2, 5))
    axis.legend(fontsize=9)
    told = table(caption, ("splats", *LINES), lines)
    return Told([told], {"levels": (caption, figure)}, {"levels": points})

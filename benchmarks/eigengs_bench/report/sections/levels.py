"""PSNR over how many splats of a set are drawn, from the rows that `levels` measured."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import pandas as pd

from eigengs_bench.harness.store import Row
from eigengs_bench.report.charts import new_figure
from eigengs_bench.report.frames import (
    Chart,
    Told,
    number,
    table,
)


def tell(rows: Sequence[Row], name: str) -> Told:
    """Lay out PSNR over splats that are drawn.

    Parameters
    ----------
    rows : sequence of dict
        Of `eigengs_bench.experiments.levels.run`.
    name : str
        The image.
    """
    points = pd.DataFrame(rows)

    def lines() -> Iterator[tuple[str, ...]]:
        for point in points.itertuples():
            values = (point.levels, point.alone, point.sorted)
            star = " *" if point.level else ""
            yield f"{point.splats:,}{star}", *(number(value, 2) for value in values)

    caption = (
        f"{name}: PSNR in YCbCr by splats drawn (* a level ends): the first of a set in levels, a "
        "fit of as many, and the most valuable ones of a fit without levels"
    )
    told = table(caption, ("splats", "levels", "fit of as many", "sorted fit"), lines())
    figure = new_figure(6.4, 4.6)
    axis = figure.subplots()
    for field, label, style in (
        ("alone", "a fit of as many", "o--"),
        ("levels", "the first of one set, fitted in levels", "o-"),
        ("sorted", "the most valuable of one set without levels", "s:"),
    ):
        axis.plot(points.splats, points[field], style, ms=4, label=label)
    for end in points.splats[points.level]:
        axis.axvline(end, color="#888888", lw=0.6)
    axis.set_xscale("log", base=2)
    axis.xaxis.set_major_formatter("{x:,.0f}")
    axis.set(xlabel="Gaussians drawn", ylabel="PSNR in YCbCr / dB")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=9)
    figure.suptitle(f"Levels of detail: {name}; lines mark where levels end")
    return Told([told], [Chart("levels", caption, figure)], {"levels": points})

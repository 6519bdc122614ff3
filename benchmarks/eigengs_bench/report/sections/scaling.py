"""What size costs, from the rows that `scaling` measured."""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from eigengs_bench.harness.store import Row
from eigengs_bench.report import frames as fr
from eigengs_bench.report.charts import label_axes, new_figure

TIME, MEMORY = "a step with lists / ms", "peak of memory / GiB"
STYLES = ("o-", "s--", "^:", "D-.")


def _one(values: pd.Series, decimals: int = 2) -> str:
    return fr.number(values.iloc[-1], decimals)


DESCENT = {
    "step, ms": ("step_ms", _one),
    "with lists, ms": ("mean_ms", _one),
    "ns a pixel": ("ns_a_pixel", partial(_one, decimals=1)),
    "placing, s": ("place_seconds", _one),
    "colour solve, s": ("solve_seconds", _one),
    "peak, GiB": ("peak_gib", _one),
}
FITS = {
    "images a second": ("images_per_second", partial(_one, decimals=1)),
    "peak, GiB": ("peak_gib", _one),
}


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out seconds and memory over pixels, Gaussians and threads: tables and charts."""
    parts = {str(name): part for name, part in _frame(rows).groupby("part", sort=False)}
    tables, charts = [], {}
    for name, (summary, chart) in PARTS.items():
        if name in parts:
            part = parts[name]
            tables.append(summary(part))
            if chart:
                caption = tables[-1].caption
                charts[f"scaling-{name}"] = caption, chart(part)
    return fr.Section(tables, charts)


def slope(x: Iterable[float], y: Iterable[float]) -> float:
    """Fit the exponent p of ``y ~ x^p`` by least squares of logarithms; NaN for one point."""
    steps, rises = (np.log(np.asarray(list(values), float)) for values in (x, y))
    steps, rises = steps - steps.mean(), rises - rises.mean()
    return float(steps @ rises / (steps @ steps)) if steps.any() else float("nan")


def _frame(rows: Sequence[Row]) -> pd.DataFrame:
    frame = fr.frame_of(rows)
    frame["size"] = [f"{w:,}x{h:,}" for w, h in zip(frame.width, frame.height, strict=True)]
    frame["pixels"] = frame.width * frame.height
    frame["Gaussians"] = frame.gaussians.map("{:,}".format)
    return frame.sort_values(["pixels", "gaussians", "threads"], kind="stable")


def _slope_over(part: pd.DataFrame, x: str, y: str = "mean_ms") -> str:
    return fr.number(slope(part[x], part[y]), 2)


def _pixels_table(part: pd.DataFrame) -> fr.Table:
    caption = (
        "Time and memory over pixels, at equal density of Gaussians: a step grows with exponent "
        f"{_slope_over(part, 'pixels')} of the pixels, memory with "
        f"{_slope_over(part, 'pixels', 'peak_gib')}"
    )
    return fr.grouped(caption, part, ["size", "Gaussians"], DESCENT)


def _splats_table(part: pd.DataFrame) -> fr.Table:
    slopes = (f"{s} {_slope_over(of, 'gaussians')}" for s, of in part.groupby("size", sort=False))
    caption = f"Time and memory over Gaussians: exponents of a step are {', '.join(slopes)}"
    return fr.grouped(caption, part, ["size", "Gaussians"], DESCENT)


def _threads_table(part: pd.DataFrame) -> fr.Table:
    gains = part.mean_ms / part.groupby("size").mean_ms.transform("first")
    part = part.assign(gain=1 / gains, threads=part.threads.map(str))
    columns = {k: DESCENT[k] for k in ("step, ms", "with lists, ms")} | {"gain": ("gain", _one)}
    caption = "Time of a step over threads, and the gain of the mean over one thread"
    return fr.grouped(caption, part, ["size", "Gaussians", "threads"], columns)


def _fits_table(part: pd.DataFrame) -> fr.Table:
    steps = " or ".join(f"{n:,}" for n in sorted(set(part.iterations)))
    caption = f"Small images: fits of {steps} steps, one after the other"
    return fr.grouped(caption, part, ["size", "Gaussians"], FITS)


def _size_chart(part: pd.DataFrame, x: str, by: list[str]) -> Figure:
    """Draw time and memory side by side; with `by`, a line a group."""
    figure = new_figure(10, 4.2)
    groups = part.groupby(by, sort=False) if by else [(("equal density of Gaussians",), part)]
    for axis, (y, label) in zip(
        figure.subplots(1, 2), {"mean_ms": TIME, "peak_gib": MEMORY}.items(), strict=True
    ):
        for ((name, *_), some), style in zip(groups, STYLES, strict=False):
            text = f"{name}, exponent {_slope_over(some, x, y)}"
            axis.plot(some[x], some[y], style, ms=4, label=text)
        axis.set(xscale="log", yscale="log", xlabel=x, ylabel=label)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8, framealpha=0.6)
    return figure


def _threads_chart(part: pd.DataFrame) -> Figure:
    figure = new_figure(5, 4.2)
    axis = figure.subplots()
    for (size, some), style in zip(part.groupby("size", sort=False), STYLES, strict=False):
        axis.plot(some.threads, some.mean_ms.iloc[0] / some.mean_ms, style, ms=4, label=size)
    most = part.threads.max()
    axis.plot([1, most], [1, most], color="#888888", lw=0.6)
    label_axes(axis, "threads", "times as fast as one thread", "", xticks=sorted(set(part.threads)))
    return figure


PARTS: dict[str, tuple[Any, Any]] = {  # what makes the table of a part, and its chart
    "pixels": (_pixels_table, partial(_size_chart, x="pixels", by=[])),
    "splats": (_splats_table, partial(_size_chart, x="gaussians", by=["size"])),
    "threads": (_threads_table, _threads_chart),
    "small": (_fits_table, None),
}

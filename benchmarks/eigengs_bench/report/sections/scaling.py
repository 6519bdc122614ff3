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


def _slope_over(part: pd.DataFrame, x: str) -> str:
    return fr.number(slope(part[x], part.mean_ms), 2)


def _bytes_a_pixel(part: pd.DataFrame) -> str:
    """Compare the memory of the smallest and of the largest image."""
    (few, low), (many, high) = part[["pixels", "peak_gib"]].to_numpy(float)[[0, -1]]
    return fr.number((high - low) * 2**30 / (many - few) if many > few else None, 0)


def _pixels_table(part: pd.DataFrame) -> fr.Table:
    caption = (
        "Time and memory over pixels, at equal density of Gaussians: a step grows with exponent "
        f"{_slope_over(part, 'pixels')} of the pixels, "
        f"memory by {_bytes_a_pixel(part)} bytes a pixel"
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


def _size_chart(part: pd.DataFrame, x: str, name: str) -> Figure:
    """Draw time and memory side by side: a line for images of one density, or of one size each."""
    figure = new_figure(10, 4.2)
    sizes = ["equal density of Gaussians"] * len(part) if x == "pixels" else part["size"]
    axes = figure.subplots(1, 2)
    for (size, some), style in zip(part.groupby(np.array(sizes), sort=False), STYLES, strict=False):
        exponent = f"{size}, exponent {_slope_over(some, x)}"
        axes[0].plot(some[x], some.mean_ms, style, ms=4, label=exponent)
        axes[1].plot(some[x], some.peak_gib, style, ms=4, label=size)
    for axis, label in zip(axes, ("a step with lists / ms", "peak of memory / GiB"), strict=True):
        label_axes(axis, name, label, "y", xscale="log")
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
    "pixels": (_pixels_table, partial(_size_chart, x="pixels", name="pixels of the image")),
    "splats": (_splats_table, partial(_size_chart, x="gaussians", name="Gaussians")),
    "threads": (_threads_table, _threads_chart),
    "small": (_fits_table, None),
}

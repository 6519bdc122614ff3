"""Speed against accuracy, from the rows that `pareto` measured: fronts, tables and charts."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from eigengs_bench.experiments.pareto import WIDE
from eigengs_bench.harness.store import Row
from eigengs_bench.report import frames as fr
from eigengs_bench.report.charts import COLORS, INK, label_axes, new_figure

PSNRS = ["psnr_ycbcr", "psnr_rgb", "psnr_wide"]
FIT = ["set", "image", "knob", "value"]

SET_CAPTION = (
    "All fits of a set, and the same by setting. The grey band is the front of all, the dashed "
    "line is the front of fits with as many Gaussians."
)
VARIANTS: dict[str, Any] = {
    "s, start": ("seconds_start", partial(fr.quartiles, decimals=3)),
    "YCbCr, start": ("psnr_ycbcr_start", fr.spread),
    "s": ("seconds", fr.quartiles),
    "YCbCr": ("psnr_ycbcr", fr.spread),
    "RGB": ("psnr_rgb", fr.spread),
    f"YCbCr at {WIDE:g} sigma": ("psnr_wide", fr.spread),
    "on front": ("front", "first"),
    "as many": ("front_same", "first"),
}
STORAGE = {
    "KiB": ("bytes", lambda values: fr.number(values.iloc[0] / 1024)),
    "YCbCr": ("psnr_ycbcr", fr.spread),
    "RGB": ("psnr_rgb", fr.spread),
}
KERNELS = {
    "forward, ms": ("forward_ms", partial(fr.mean, decimals=2)),
    "and reverse, ms": ("step_ms", partial(fr.mean, decimals=2)),
    "largest error": ("largest_error", lambda values: f"{values.mean():.1e}"),
    "RMS error": ("rms_error", lambda values: f"{values.mean():.1e}"),
}


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out what was measured: a table and a chart a set, of storage, and of the renderer."""
    fits, tables, charts = fr.frame_of(rows, "trace"), [], {}
    for name, part in fits.groupby("set", sort=False) if len(fits) else ():
        points = points_of(part)
        tables.append(_variants(name, part, points))
        charts[f"pareto-{name}"] = SET_CAPTION + fr.remark(part.code), set_chart(points, name)
    if len(stored := fr.frame_of(rows, "stored")):
        caption = "The default fits, stored in fewer bits a parameter: PSNR / dB"
        named = stored.assign(**{"stored as": stored.set + " " + stored.precision})
        tables.append(fr.grouped(caption, named, ["stored as"], STORAGE))
        charts["pareto-storage"] = tables[-1].caption, storage_chart(stored)
    if len(kernels := fr.frame_of(rows, "kernels")):
        caption = "The renderer: time, and what its cutoff leaves out of a picture (1 is white)"
        named = kernels.sort_values("renderer", kind="stable")
        named["cutoff"] = named.renderer + " " + named.cutoff.map("{:g}".format)
        tables.append(fr.grouped(caption, named, ["cutoff"], KERNELS))
        charts["pareto-kernels"] = tables[-1].caption, kernels_chart(kernels)
    return fr.Section(tables, charts)


def points_of(fits: pd.DataFrame) -> pd.DataFrame:
    """Gather the images of a set: medians of seconds and means of PSNRs, NaN where a fit failed.

    "front" and "front_same" are 1 on the front of all points, and on the front of points with as
    many Gaussians as the default fit.
    """
    groups = fits.groupby(["knob", "value", "iteration", "gaussians"], sort=False)
    points = groups[PSNRS].agg(lambda values: values.mean(skipna=False))
    points.insert(0, "seconds", groups.seconds.median())
    points = points.assign(images=groups.size()).reset_index()
    same = points.gaussians.isin(points.gaussians[points.value == "default"])
    for column, some in (("front", points), ("front_same", points[same])):
        best = front(list(zip(some.seconds, some.psnr_ycbcr, strict=True)))
        on = [
            p.Index in some.index and (p.seconds, p.psnr_ycbcr) in best for p in points.itertuples()
        ]
        points[column] = pd.Series(on).astype(int)
    return points


def front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Find the points (seconds, PSNR) of which none is as fast and better, or faster and as good.

    From the fastest to the best; of equal points one; no point with NaN is on a front.
    """
    best, kept = -math.inf, []
    known = [point for point in points if not any(map(math.isnan, point))]
    for seconds, reached in sorted(known, key=lambda point: (point[0], -point[1])):
        if reached > best:
            best = reached
            kept.append((seconds, reached))
    return kept


def _variants(name: str, fits: pd.DataFrame, points: pd.DataFrame) -> fr.Table:
    steps = fits.iteration.max()
    start, ends = fits[fits.iteration == 0], fits[fits.iteration == steps]
    lines = ends.merge(start[[*FIT, "seconds", "psnr_ycbcr"]], on=FIT, suffixes=("", "_start"))
    lines["fit"] = lines.knob + " " + lines.value.map(text_of)
    for key in ("front", "front_same"):
        on = points[points[key] == 1].groupby(["knob", "value"], sort=False).iteration
        at = on.agg(lambda values: ", ".join(f"{step:,}" for step in values)).rename(key)
        lines = lines.join(at, on=["knob", "value"]).fillna({key: fr.MISSING})
    caption = (
        f"{name}, {fr.counted(fits.image)}: seconds and PSNR at the start and after {steps:,} "
        "steps; after how many steps a fit is on the front of all fits, and on the front of fits "
        "with as many Gaussians; other settings are the default ones"
    )
    return fr.grouped(caption, lines, ["fit"], VARIANTS)


# What a knob is, its colour and marker, and its value in the default fit (or that of eigengs).
KNOBS = {
    "init": ("Where Gaussians start", "#8a4f9e", "s", "adaptive"),
    "solve steps": ("Steps of the colour solve", "#c27c0e", "^", "10"),
    "cutoff": ("Cutoff in standard deviations", "#7a5c43", "D", "3"),
    "gaussians": ("Number of Gaussians", "#1f9e89", "v", ""),
    "components": ("Components a channel of eigengs", "#5a8f3c", "P", "300"),
}
LABELS = ("seconds, start included", "PSNR in YCbCr / dB")


def set_chart(points: pd.DataFrame, name: str) -> Figure:
    """Draw all fits of a set (see `points_of`) and their front, and below a panel a setting."""
    title = f"Speed against accuracy: {name}, images: {points.images.max()}; up and left is better"
    figure, knobs = new_figure(10, 11.5, title), list(KNOBS)
    rows: Any = [3 * ["all"], knobs[:3], [*knobs[3:], "."]]
    axes = figure.subplot_mosaic(rows, height_ratios=(2.4, 1, 1))
    _overview(axes["all"], points)
    for knob in knobs:
        _panel(axes[knob], points, knob)
    return figure


def _overview(axis: Axes, points: pd.DataFrame) -> None:
    for knob, (title, color, marker, _) in KNOBS.items():
        if len(some := points[points.knob == knob]):
            _plot(axis, some, title, color=color, marker=marker, ls="none", ms=5, alpha=0.75)
    for preset, color in COLORS.items():
        _plot(axis, _line(points, "preset", preset), preset, color=color, marker="o")
    same, edge = (points[points[k] == 1].sort_values("seconds") for k in ("front_same", "front"))
    label = f"front of fits with {same.gaussians.max():,} Gaussians"
    _plot(axis, same, label, color=INK, lw=1.2, ls="--")
    _plot(axis, edge, "front: none is better", color=INK, lw=8, alpha=0.18)
    label_axes(axis, *LABELS)
    axis.set_xlim(points.seconds.min() / 6)  # room for names on the left of the points
    low, high = axis.get_ylim()
    taken = np.inf
    for point in edge[::-1].itertuples():  # above and left of the front nothing lies
        if taken - point.psnr_ycbcr > 0.03 * (high - low):
            named = f"{point.knob} {text_of(point.value)}, {point.iteration:,} steps"
            place, taken = (point.seconds, point.psnr_ycbcr), point.psnr_ycbcr
            style: Any = {"textcoords": "offset points", "ha": "right", "fontsize": 8.5}
            axis.annotate(named, place, (-6, 3), **style)


def _panel(axis: Axes, points: pd.DataFrame, knob: str) -> None:
    title, color, marker, usual = KNOBS[knob]
    base = "eigengs" if knob == "components" else "default"
    values = points.value[points.knob == knob].unique()
    for value, strength in zip(values, np.linspace(0.35, 1, len(values)), strict=True):
        shade = tuple(1 - float(strength) * (1 - part) for part in to_rgb(color))
        _plot(axis, _line(points, knob, value), text_of(value), color=shade, marker=marker, ms=4)
    line = _line(points, "preset", base)
    usual = usual or text_of(line.gaussians.iloc[0])
    _plot(axis, line, f"{usual} ({base})", color=INK, lw=2.5)
    label_axes(axis, *LABELS, title=title)


def _plot(axis: Axes, points: pd.DataFrame, label: str, **style: Any) -> None:
    axis.plot(points.seconds, points.psnr_ycbcr, label=label, **style)


def _line(points: pd.DataFrame, knob: str, value: str | float) -> pd.DataFrame:
    return points[(points.knob == knob) & (points.value == value)].sort_values("iteration")


def text_of(value: str | float) -> str:
    """Write the value of a knob."""
    return value if isinstance(value, str) else f"{value:,g}"


def kernels_chart(kernels: pd.DataFrame) -> Figure:
    """Draw what the cutoff leaves out of a picture over the time that it takes."""
    figure = new_figure(10, 4.6)
    panels = {"forward_ms": "Forward", "step_ms": "Forward and reverse"}
    for axis, (what, title) in zip(figure.subplots(1, 2, sharey=True), panels.items(), strict=True):
        for color, (renderer, mine) in zip(
            COLORS.values(), kernels.groupby("renderer"), strict=False
        ):
            axis.plot(
                mine[what], mine.largest_error, "o-", color=color, label=f"{renderer}, largest"
            )
            axis.plot(mine[what], mine.rms_error, "s--", color=color, label=f"{renderer}, RMS")
            for place in zip(mine.cutoff, mine[what], mine.largest_error, strict=True):
                axis.annotate(f"{place[0]:g} sigma", place[1:], fontsize=8.5)
        label_axes(axis, "milliseconds", "error (1 is white)", title=title, yscale="log")
    return figure


def storage_chart(stored: pd.DataFrame) -> Figure:
    """Draw the PSNR of the default fits over the bytes that store them; means over the images."""
    figure = new_figure(8, 4.6)
    axis = figure.subplots()
    groups = stored.groupby(["set", "precision"], sort=False)
    means = groups.agg(size=("bytes", "first"), psnr=("psnr_ycbcr", "mean")).reset_index()
    for name, part in means.groupby("set", sort=False):
        bits = part.precision.str.contains("bits")
        (line,) = axis.plot(part["size"][bits] / 1024, part.psnr[bits], "o-", label=name)
        floats = part["size"][~bits] / 1024, part.psnr[~bits]
        axis.plot(*floats, "D", mfc="none", color=line.get_color())
        for row in part.itertuples():
            axis.annotate(row.precision, (row.size / 1024, row.psnr), fontsize=9)
    label_axes(axis, "KiB", "PSNR in YCbCr / dB", "")
    return figure

"""Charts of speed against accuracy."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from eigengs_bench.report.charts import COLORS, INK, label_axes, new_figure
from eigengs_bench.report.frames import counted

# What a knob is, its colour and marker, and its value in the default fit (or that of eigengs).
KNOBS = {
    "init": ("Where splats start", "#8a4f9e", "s", "adaptive"),
    "solve steps": ("Steps of the colour solve", "#c27c0e", "^", "10"),
    "cutoff": ("Cutoff in standard deviations", "#7a5c43", "D", "3"),
    "gaussians": ("Number of Gaussians", "#1f9e89", "v", ""),
    "components": ("Components a channel of eigengs", "#5a8f3c", "P", "300"),
}
LABELS = ("seconds, start included", "PSNR in YCbCr / dB")


def set_chart(points: pd.DataFrame, name: str) -> Figure:
    """Draw all fits of a set (see `points_of`) and their front, and below a panel a setting."""
    knobs = [knob for knob in KNOBS if (points.knob == knob).any()]
    images = counted(points.images.max())
    figure = new_figure(
        10, 11.5, f"Speed against accuracy: {name}, {images}; up and left is better"
    )
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.1, 1))[:, 0]
    axis = upper.subplots()
    _overview(axis, points)
    upper.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9)
    axes = lower.subplots(2, 3).flatten()
    for axis, knob in zip(axes, knobs, strict=False):
        _panel(axis, points, knob)
    for axis in axes[len(knobs) :]:
        axis.set_axis_off()
    return figure


def _overview(axis: Axes, points: pd.DataFrame) -> None:
    """All points, the lines of the methods, and the front with its names."""
    for knob, (title, color, marker, _) in KNOBS.items():
        if len(some := points[points.knob == knob]):
            _plot(axis, some, title, color=color, marker=marker, ls="none", ms=5, alpha=0.75)
    for preset, color in COLORS.items():
        if len(line := _line(points, "preset", preset)):
            _plot(axis, line, preset, color=color, marker="o")
    same = points[points.front_same == 1].sort_values("seconds")
    label = f"front of those with {same.gaussians.max():,} splats"
    _plot(axis, same, label, color=INK, lw=1.2, ls="--")
    edge = points[points.front == 1].sort_values("seconds")
    _plot(axis, edge, "front: none is better", color=INK, lw=8, alpha=0.18)
    label_axes(axis, *LABELS)
    axis.set_xlim(points.seconds.min() / 6)  # room for names on the left of the points
    low, high = axis.get_ylim()
    taken = np.inf
    for point in edge[::-1].itertuples():  # above and left of the front nothing lies
        if taken - point.psnr_ycbcr > 0.03 * (high - low):
            named = f"{point.knob} {_text(point.value)}, {point.iteration:,} steps"
            place, taken = (point.seconds, point.psnr_ycbcr), point.psnr_ycbcr
            style: Any = {"textcoords": "offset points", "ha": "right", "fontsize": 8.5}
            axis.annotate(named, place, (-6, 3), **style)


def _panel(axis: Axes, points: pd.DataFrame, knob: str) -> None:
    """The fits that differ in one setting, and the one that they differ from."""
    title, color, marker, usual = KNOBS[knob]
    base = "eigengs" if knob == "components" else "default"
    values = points.value[points.knob == knob].unique()
    for value, strength in zip(values, np.linspace(0.35, 1, len(values)), strict=True):
        shade = tuple(1 - float(strength) * (1 - part) for part in to_rgb(color))
        _plot(axis, _line(points, knob, value), _text(value), color=shade, marker=marker, ms=4)
    line = _line(points, "preset", base)
    usual = usual or _text(line.gaussians.iloc[0])
    _plot(axis, line, f"{usual} ({base})", color=INK, lw=2.5)
    label_axes(axis, *LABELS, title=title)
    axis.legend(fontsize=8, framealpha=0.6)


def _plot(axis: Axes, points: pd.DataFrame, label: str, **style: Any) -> None:
    axis.plot(points.seconds, points.psnr_ycbcr, label=label, **style)


def _line(points: pd.DataFrame, knob: str, value: str | float) -> pd.DataFrame:
    return points[(points.knob == knob) & (points.value == value)].sort_values("iteration")


def _text(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:,g}"


def kernels_chart(kernels: pd.DataFrame) -> Figure:
    """Draw what the cutoff leaves out of a picture over the time that it takes."""
    figure = new_figure(10, 4.6)
    panels = {"forward_ms": "Forward", "step_ms": "Forward and reverse"}
    for axis, (what, title) in zip(figure.subplots(1, 2, sharey=True), panels.items(), strict=True):
        for renderer, color in (("fast", COLORS["default"]), ("plain", COLORS["gaussianimage"])):
            mine = kernels[kernels.renderer == renderer]
            for error, style in (("largest_error", "o-"), ("rms_error", "s--")):
                label = f"{renderer}, {error.replace('_', ' ')}"
                axis.plot(mine[what], mine[error], style, color=color, label=label)
            for row in mine.itertuples():
                place = (getattr(row, what), row.largest_error)
                axis.annotate(f"{row.cutoff:g} sigma", place, fontsize=8.5)
        label_axes(axis, "milliseconds", "error (1 is white)", title=title, yscale="log")
    figure.axes[0].legend(fontsize=9)
    return figure


def storage_chart(stored: pd.DataFrame) -> Figure:
    """Draw the PSNR of the default fits over the bytes that store them; means over the images."""
    figure = new_figure(8, 4.6)
    axis = figure.subplots()
    groups = stored.groupby(["set", "precision"], sort=False)
    means = groups.agg({"bytes": "first", "psnr_ycbcr": "mean"}).reset_index()
    for name, part in means.groupby("set", sort=False):
        bits = part[part.precision.str.contains("bits")]
        floats = part[part.precision.str.contains("float")]
        (line,) = axis.plot(bits.bytes / 1024, bits.psnr_ycbcr, "o-", label=name)
        axis.plot(floats.bytes / 1024, floats.psnr_ycbcr, "D", mfc="none", color=line.get_color())
        for row in part.itertuples():
            axis.annotate(row.precision, (row.bytes / 1024, row.psnr_ycbcr), fontsize=9)
    label_axes(axis, "KiB", "PSNR in YCbCr / dB", "")
    axis.legend(fontsize=9)
    return figure

"""Charts of speed against accuracy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from eigengs_bench.experiments.pareto import DEFAULT_COMPONENTS
from eigengs_bench.report.charts import COLORS, INK, logarithmic, new_figure
from eigengs_bench.report.frames import counted
from eigengs_dr.rendering import CUTOFF

KNOBS = {
    "init": ("Where splats start", "#8a4f9e", "s"),
    "solve steps": ("Steps of the colour solve", "#c27c0e", "^"),
    "cutoff": ("Cutoff in standard deviations", "#7a5c43", "D"),
    "gaussians": ("Number of Gaussians", "#1f9e89", "v"),
    "components": ("Components a channel of eigengs", "#5a8f3c", "P"),
}
"""What a knob is, its colour and its marker; presets have lines of their own."""

DEFAULTS = {
    "init": "adaptive",
    "solve steps": "10",
    "cutoff": f"{CUTOFF:g}",
    "components": str(DEFAULT_COMPONENTS),
}
"""Values of the knobs in the default fit, and in that of the preset "eigengs"."""


def set_chart(points: pd.DataFrame, name: str) -> Figure:
    """Draw all fits of a set and their front, and below a panel a setting.

    Parameters
    ----------
    points : DataFrame
        From `eigengs_bench.report.sections.pareto.points_of`.
    name : str
        The set, for the title.
    """
    knobs = [knob for knob in KNOBS if (points.knob == knob).any()]
    figure = new_figure(10, 11.5)
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.1, 1))[:, 0]
    images = counted(points.images.max(), "image")
    figure.suptitle(f"Speed against accuracy: {name}, {images}; up and left is better")
    axis = upper.subplots()
    _overview(axis, points)
    upper.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9)
    axes = lower.subplots(2, 3 if len(knobs) > 4 else 2).flatten()
    for axis, knob in zip(axes, knobs, strict=False):
        _panel(axis, points, knob)
    for axis in axes[len(knobs) :]:
        axis.set_axis_off()
    return figure


def _overview(axis: Axes, points: pd.DataFrame) -> None:
    """All points, the lines of the methods, and the front with its names."""
    for knob, (title, color, marker) in KNOBS.items():
        some = points[points.knob == knob]
        if len(some):
            style: Any = {"color": color, "marker": marker, "linestyle": "none"}
            axis.plot(some.seconds, some.psnr_ycbcr, **style, ms=5, alpha=0.75, label=title)
    for preset, color in COLORS.items():
        line = _line(points, "preset", preset)
        if len(line):
            axis.plot(line.seconds, line.psnr_ycbcr, color=color, marker="o", lw=1.5, label=preset)
    for column, style in (
        ("front_same", {"lw": 1.2, "ls": "--"}),
        ("front", {"lw": 8, "alpha": 0.18}),
    ):
        edge = points[points[column] == 1].sort_values(["seconds", "psnr_ycbcr"])
        label = "front: none is better"
        if column == "front_same" and len(edge):
            label = f"front of those with {edge.gaussians.iloc[0]:,} splats"
        axis.plot(edge.seconds, edge.psnr_ycbcr, color=INK, label=label, **style)
    _label_axes(axis)
    axis.set_xlim(points.seconds.min() / 6)  # room for names on the left of the points
    _name(axis, edge)


def _name(axis: Axes, edge: pd.DataFrame) -> None:
    """Write beside the points of the front what they are: above and left of it nothing lies."""
    low, high = axis.get_ylim()
    taken = np.inf
    for point in edge[::-1].itertuples():
        if taken - point.psnr_ycbcr > 0.03 * (high - low):
            value = _text(point.value)
            named = {"gaussians": f"{value} splats", "preset": value}
            axis.annotate(
                f"{named.get(point.knob, f'{point.knob} {value}')}, {point.iteration:,} steps",
                (point.seconds, point.psnr_ycbcr),
                (-6, 3),
                textcoords="offset points",
                ha="right",
                fontsize=8.5,
                color=INK,
            )
            taken = point.psnr_ycbcr


def _panel(axis: Axes, points: pd.DataFrame, knob: str) -> None:
    """The fits that differ in one setting, and the one that they differ from."""
    title, color, marker = KNOBS[knob]
    base = "eigengs" if knob == "components" else "default"
    values = points.value[points.knob == knob].unique()
    for value, strength in zip(values, np.linspace(0.35, 1, len(values)), strict=True):
        line = _line(points, knob, value)
        shade = tuple(1 - float(strength) * (1 - part) for part in to_rgb(color))
        style: Any = {"color": shade, "marker": marker, "ms": 4}
        axis.plot(line.seconds, line.psnr_ycbcr, **style, label=_text(value))
    line = _line(points, "preset", base)
    usual = DEFAULTS.get(knob) or _text(line.gaussians.iloc[0])
    axis.plot(line.seconds, line.psnr_ycbcr, color=INK, lw=2.5, label=f"{usual} ({base})")
    axis.set_title(title, fontsize=10)
    axis.legend(fontsize=8, framealpha=0.6)
    _label_axes(axis)


def _label_axes(axis: Axes) -> None:
    logarithmic(axis)
    axis.set_xlabel("seconds, start included", fontsize=9)
    axis.set_ylabel("PSNR in YCbCr / dB", fontsize=9)
    axis.grid(alpha=0.3)


def _line(points: pd.DataFrame, knob: str, value: str | float) -> pd.DataFrame:
    return points[(points.knob == knob) & (points.value == value)].sort_values("iteration")


def _text(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:,g}"


def kernels_chart(kernels: pd.DataFrame) -> Figure:
    """Draw what the cutoff leaves out of a picture over the time that it takes.

    Parameters
    ----------
    kernels : DataFrame
        See `eigengs_bench.experiments.pareto.kernel_job`.
    """
    figure = new_figure(10, 4.6)
    panels = {"forward_ms": "Forward", "step_ms": "Forward and reverse"}
    for axis, (what, title) in zip(figure.subplots(1, 2, sharey=True), panels.items(), strict=True):
        for renderer, color, whose in (
            ("fast", COLORS["default"], "our kernels"),
            ("plain", COLORS["gaussianimage"], "plain Dr.Jit"),
        ):
            mine = kernels[kernels.renderer == renderer]
            for error, style, label in (
                ("largest_error", "o-", "largest"),
                ("rms_error", "s--", "root mean square"),
            ):
                axis.plot(mine[what], mine[error], style, color=color, label=f"{whose}, {label}")
            for row in mine.itertuples():
                place = (getattr(row, what), row.largest_error)
                text = f"{row.cutoff:g} sigma"
                axis.annotate(text, place, (5, 4), textcoords="offset points", fontsize=8.5)
        logarithmic(axis)
        axis.set(yscale="log", xlabel="milliseconds", title=title)
        axis.margins(0.2, 0.08)
        axis.grid(alpha=0.3)
    first = figure.axes[0]
    first.set_ylabel("error of a picture (1 is white)")
    handles, labels = first.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=9)
    return figure


def storage_chart(stored: pd.DataFrame) -> Figure:
    """Draw the PSNR of the default fits over the bytes that store them; means over the images."""
    figure = new_figure(8, 4.6)
    axis = figure.subplots()
    groups = stored.groupby(["set", "precision"], sort=False)
    means = groups.agg(bytes=("bytes", "first"), psnr=("psnr_ycbcr", "mean")).reset_index()
    means["size"] = means.bytes / 1024
    for name, part in means.groupby("set", sort=False):
        bits = part[part.precision.str.contains("bits")]
        floats = part[part.precision.str.contains("float")]
        (line,) = axis.plot(bits["size"], bits.psnr, "o-", label=name)
        axis.plot(floats["size"], floats.psnr, "D", mfc="none", color=line.get_color())
    highest = means.groupby(["precision", "size"], sort=False).psnr.max()
    for (precision, size), decibels in highest.items():
        # 16 bits and float16 take as much: one is named on the left, one on the right.
        away, side = ((8, -3), "left") if "float" in precision else ((-5, 5), "right")
        place = (size, decibels)
        axis.annotate(precision, place, away, textcoords="offset points", ha=side, fontsize=9)
    axis.set(xlabel="KiB", ylabel="PSNR in YCbCr / dB")
    axis.margins(0.15, 0.12)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=9)
    return figure

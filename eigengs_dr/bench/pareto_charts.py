"""Charts of speed against accuracy."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..gaussian.file import CUTOFF
from .charts import COLORS, new_figure
from .pareto import DEFAULT_COMPONENTS
from .pareto_tables import Point, stored_by_set, text_of
from .rows import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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

INK = "#222222"


def set_chart(drawn: list[Point], name: str) -> Figure:
    """Draw all fits of a set and their front, and below a panel a setting.

    Parameters
    ----------
    drawn : list of Point
        From `points`.
    name : str
        The set, for the title.

    Raises
    ------
    ValueError
        If matplotlib is not installed.
    """
    knobs = [k for k in KNOBS if any(p.knob == k for p in drawn)]
    figure = new_figure(10, 11.5)
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.1, 1))[:, 0]
    images = len(drawn[0].seconds)
    figure.suptitle(f"Speed against accuracy: {name}, {images} image{'s'[: images > 1]}")
    axis = upper.subplots()
    _overview(axis, drawn)
    upper.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9)
    axes = lower.subplots(2, 3 if len(knobs) > 4 else 2).flatten()
    for axis, knob in zip(axes, knobs, strict=False):
        _panel(axis, drawn, knob)
    for axis in axes[len(knobs) :]:
        axis.set_axis_off()
    return figure


def _overview(axis: Axes, drawn: list[Point]) -> None:
    """All points, the lines of the methods, and the front with its names."""
    for knob, (title, color, marker) in KNOBS.items():
        places = [p.place for p in drawn if p.knob == knob]
        if places:
            style: Any = {"color": color, "marker": marker, "linestyle": "none"}
            axis.plot(*zip(*places, strict=True), **style, ms=5, alpha=0.75, label=title)
    for preset, color in COLORS.items():
        line = _line(drawn, "preset", preset)
        if line:
            axis.plot(*zip(*line, strict=True), color=color, marker="o", lw=1.5, label=preset)
    same = sorted((p for p in drawn if p.front_same), key=lambda p: p.place)
    label = f"front of those with {same[0].gaussians:,} splats"
    axis.plot(*zip(*[p.place for p in same], strict=True), color=INK, lw=1.2, ls="--", label=label)
    best = sorted((p for p in drawn if p.front), key=lambda p: p.place)
    edge = [p.place for p in best]
    axis.plot(*zip(*edge, strict=True), color=INK, lw=8, alpha=0.18, label="front: none is better")
    _spans(axis, drawn)
    _name(axis, best)
    axis.set_title(
        "Each point is the default fit, or one with a single setting changed, after some number of "
        "steps;\nas rates fall over a run, each number is a run of its own (gaussianimage, "
        "eigengs: one run). Up and left is better.",
        fontsize=10,
    )


def _name(axis: Axes, best: list[Point]) -> None:
    """Write beside the points of the front what they are: above and left of it nothing lies."""
    low, high = axis.get_ylim()
    taken = np.inf
    for point in reversed(best):
        seconds, decibels = point.place
        if taken - decibels > 0.03 * (high - low):
            value = text_of(point.value)
            named = {"gaussians": f"{value} splats", "preset": value}
            what = named.get(point.knob, f"{point.knob} {value}")
            axis.annotate(
                f"{what}, {text_of(point.iteration)} steps",
                (seconds, decibels),
                (-6, 3),
                textcoords="offset points",
                ha="right",
                fontsize=8.5,
                color=INK,
            )
            taken = decibels


def _panel(axis: Axes, drawn: list[Point], knob: str) -> None:
    """The fits that differ in one setting, and the one that they differ from."""
    title, color, marker = KNOBS[knob]
    base = "eigengs" if knob == "components" else "default"
    values = list(dict.fromkeys(p.value for p in drawn if p.knob == knob))
    for value, strength in zip(values, np.linspace(0.35, 1, len(values)), strict=True):
        line = _line(drawn, knob, value)
        shade = _shade(color, float(strength))
        axis.plot(*zip(*line, strict=True), color=shade, marker=marker, ms=4, label=text_of(value))
    usual = DEFAULTS.get(knob) or text_of(next(p for p in drawn if p.value == base).gaussians)
    line = _line(drawn, "preset", base)
    axis.plot(*zip(*line, strict=True), color=INK, lw=2.5, label=f"{usual} ({base})")
    axis.set_title(title, fontsize=10)
    axis.legend(fontsize=8, framealpha=0.6)
    _spans(axis, [])


def _spans(axis: Axes, drawn: list[Point]) -> None:
    """Seconds along, decibels up; room for names on the left of the points."""
    _by_factors(axis)
    if drawn:
        axis.set_xlim(min(p.place[0] for p in drawn) / 6)
    axis.set_xlabel("seconds, start included", fontsize=9)
    axis.set_ylabel("PSNR in YCbCr / dB", fontsize=9)
    axis.grid(alpha=0.3)


def _by_factors(axis: Axes) -> None:
    """Give an axis a logarithmic scale with plain numbers."""
    axis.set_xscale("log", subs=[3])
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_formatter("{x:g}")
    axis.tick_params(axis="x", which="both", length=4, pad=4)


def _line(drawn: list[Point], knob: str, value: str | float) -> list[tuple[float, float]]:
    line = [p for p in drawn if (p.knob, p.value) == (knob, value)]
    return [p.place for p in sorted(line, key=lambda p: p.iteration)]


def _shade(color: str, strength: float) -> tuple[float, ...]:
    """Mix a colour with white."""
    parts = (int(color[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return tuple(1 - strength * (1 - part) for part in parts)


def kernels_chart(kernels: list[Row]) -> Figure:
    """Draw what the cutoff leaves out of a picture over the time that it takes.

    Parameters
    ----------
    kernels : list of dict
        See `eigengs_dr.bench.pareto.kernel_job`.

    Raises
    ------
    ValueError
        If matplotlib is not installed.
    """
    figure = new_figure(10, 4.6)
    for axis, what, title in zip(
        figure.subplots(1, 2, sharey=True),
        ("forward_ms", "step_ms"),
        ("Forward", "Forward and reverse"),
        strict=True,
    ):
        for renderer, color in (("fast", COLORS["default"]), ("plain", COLORS["gaussianimage"])):
            mine = [row for row in kernels if row["renderer"] == renderer]
            ms = [row[what] for row in mine]
            for figures, style, label in (
                ("largest_error", "o-", "largest"),
                ("rms_error", "s--", "root mean square"),
            ):
                errors = [row[figures] for row in mine]
                whose = "our kernels" if renderer == "fast" else "plain Dr.Jit"
                axis.plot(ms, errors, style, color=color, label=f"{whose}, {label}")
            for row in mine:
                place = (row[what], row["largest_error"])
                text = f"{row['cutoff']:g} sigma"
                axis.annotate(text, place, (5, 4), textcoords="offset points", fontsize=8.5)
        _by_factors(axis)
        axis.set(yscale="log", xlabel="milliseconds", title=title)
        axis.margins(0.2, 0.08)
        axis.grid(alpha=0.3)
    first = figure.axes[0]
    first.set_ylabel("error of a picture (1 is white)")
    handles, labels = first.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=9)
    figure.suptitle("What a cutoff saves, and what it leaves out")
    return figure


def storage_chart(rows: list[Row]) -> Figure:
    """Draw the PSNR of the default fits over the bytes that store them; means over the images.

    Raises
    ------
    ValueError
        If matplotlib is not installed.
    """
    figure = new_figure(8, 4.6)
    axis = figure.subplots()
    highest: dict[tuple[str, float], float] = {}
    for name, forms in stored_by_set(rows).items():
        kept = {
            (precision, found[0]["bytes"] / 1024): float(np.mean([r["psnr_ycbcr"] for r in found]))
            for precision, found in forms.items()
        }
        cut = [(key[1], decibels) for key, decibels in kept.items() if "bits" in key[0]]
        (line,) = axis.plot(*zip(*cut, strict=True), "o-", label=name)
        for key, decibels in kept.items():
            if "float" in key[0]:
                axis.plot(key[1], decibels, "D", mfc="none", color=line.get_color())
            highest[key] = max(decibels, highest.get(key, decibels))
    for (precision, size), decibels in highest.items():
        # 16 bits and float16 take as much: one is named on the left, one on the right.
        away, side = ((8, -3), "left") if "float" in precision else ((-5, 5), "right")
        place = (size, decibels)
        axis.annotate(precision, place, away, textcoords="offset points", ha=side, fontsize=9)
    axis.set(xlabel="KiB", ylabel="PSNR in YCbCr / dB")
    axis.margins(0.15, 0.12)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=9)
    figure.suptitle("The default fit, stored in fewer bits a parameter")
    return figure

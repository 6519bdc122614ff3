"""PSNR over seconds: this package beside its alternatives, on one machine and as published.

Rows are those of other questions: "pareto" has the methods of this package on photos of
scikit-image; "kodak" has timed fits, to compare with published figures; "peers" has other programs
on this machine.
"""

from collections.abc import Mapping, Sequence
from statistics import mode

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eigengs_bench import report as fr
from eigengs_bench.kodak import published
from eigengs_bench.names import SAMPLES, SETS
from eigengs_bench.rows import Row

NAMES = {
    "default": "eigengs_dr",
    "gaussianimage": "recipe of GaussianImage",
    "eigengs": "recipe of EigenGS",
}
PEERS = (
    (fr.BLUE, "o"),
    (fr.SKY, "v"),
    (fr.RED, "s"),
    (fr.GREY, "D"),
    (fr.ORANGE, "P"),
    (fr.PINK, "X"),
    (fr.GREEN, "^"),
)


LEGIBLE = 10.5
"""Size of text in points that a chart of 5.4 inches shows with 14 pixels, and on a phone with 9."""


def charts(rows: Mapping[str, Sequence[Row]]) -> dict[str, Figure]:
    """Draw the charts of speed against accuracy, if there are rows for both of their parts."""
    if not {"pareto", "kodak"} <= rows.keys():
        return {}
    kodak = _of_one_machine(rows["kodak"])
    return {"speed": _speed({**rows, "kodak": kodak}), "kodak-speed": _kodak_alone(kodak)}


def _of_one_machine(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of the machine that measured most: seconds of two do not compare."""
    machine = mode(fr.machine_of(row["run"]) for row in rows)
    return [row for row in rows if fr.machine_of(row["run"]) == machine]


def _kodak_alone(rows: Sequence[Row]) -> Figure:
    """Draw Kodak beside published figures, for a front page that may be read on a phone."""
    figure = fr.new_figure(5.4, 5.2)
    axis = figure.subplots()
    _kodak(axis, fr.frame_of(rows), LEGIBLE)
    fr.label_axes(axis, "seconds per photo", "PSNR in RGB / dB", legend=False)
    axis.xaxis.set_minor_formatter("")
    axis.tick_params(labelsize=LEGIBLE)
    for text in (axis.xaxis.label, axis.yaxis.label):
        text.set_fontsize(LEGIBLE)
    named = axis.get_legend_handles_labels()
    figure.legend(*named, loc="outside lower center", fontsize=LEGIBLE, ncols=1)
    return figure


def _speed(rows: Mapping[str, Sequence[Row]]) -> Figure:
    """Draw methods on small photos, Kodak beside published figures, and other programs."""
    peers = fr.frame_of(rows.get("peers", []))
    figure = fr.new_figure(11.5 if len(peers) else 9, 4.8)
    axes = figure.subplots(1, 3 if len(peers) else 2)
    _methods(axes[0], fr.frame_of(rows["pareto"], "trace"))
    _kodak(axes[1], fr.frame_of(rows["kodak"]))
    if len(peers):
        _peers(axes[2], peers[peers.timed])
    for axis in axes:
        fr.label_axes(axis, "seconds per photo", "PSNR in RGB / dB", legend=False)
        axis.xaxis.set_minor_formatter("")  # the axis is of several decades
        columns = 1 + (len(axis.lines) > 5)
        axis.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.45, -0.2), ncols=columns)
    return figure


def _methods(axis: Axes, fits: pd.DataFrame) -> None:
    """Draw a line per method: fits with more and more steps, the start included."""
    fits = fits[(fits.knob == "preset") & (fits.set == SAMPLES)]
    for (method, color), marker in zip(fr.COLORS.items(), "osD", strict=True):
        points = fits[fits.value == method].groupby("iteration")[["seconds", "psnr_rgb"]]
        means = points.agg({"seconds": "median", "psnr_rgb": "mean"})
        axis.plot(
            means.seconds, means.psnr_rgb, f"{marker}-", ms=5, color=color, label=NAMES[method]
        )
    shape = SETS[SAMPLES]
    size = f"{shape.width}x{shape.height} pixels,\n{shape.gaussians:,} Gaussians, 2 cores"
    axis.set_title(f"{fits.image.nunique()} photos of {size}", fontsize=9)


def _kodak(axis: Axes, fits: pd.DataFrame, size: float = 8) -> None:
    """Draw timed fits, a line per number of steps, and published figures that have seconds."""
    timed = fits[fits.timed & (fits.iterations > 0)]
    for (steps, part), alpha in zip(timed.groupby("iterations"), (1.0, 0.5), strict=False):
        points = part.groupby("gaussians").agg({"seconds": "median", "psnr_float": "mean"})
        label = f"eigengs_dr, {steps:,} steps, by Gaussians"
        x, y = points.seconds, points.psnr_float
        axis.plot(x, y, "o-", ms=5, color=fr.BLUE, alpha=alpha, label=label)
        for count, point in points.iterrows() if alpha == 1 else ():
            words = f"{count:,} Gaussians" if count == points.index.min() else f"{count:,}"
            at = (point.seconds, point.psnr_float)
            axis.annotate(
                words, at, (-6, 3), textcoords="offset points", fontsize=size - 1, ha="right"
            )
    others = published().dropna(subset="seconds")
    marks = zip(
        others.groupby("method", sort=False), (fr.RED, fr.ORANGE, fr.GREY), "*XP", strict=False
    )
    for (name, part), color, marker in marks:
        method, counts = str(name).partition(" (")[0], ", ".join(f"{n:,}" for n in part.gaussians)
        machine, source = part.machine.iloc[0], part.source.iloc[0]
        label = f"{method}, {counts}, {machine} ({source})"
        axis.plot(part.seconds, part.psnr_float, marker, color=color, ms=9, label=label)
    axis.margins(y=0.1)  # for the words beside the topmost point
    title = f"{fits.image.nunique()} photos of Kodak,\n2 cores beside GPUs"
    axis.set_title(title, fontsize=max(size, 9))


def _peers(axis: Axes, points: pd.DataFrame) -> None:
    """Draw what each program reaches: a line per program, a point per setting."""
    groups = points.groupby("peer", sort=False)
    for (name, part), (color, marker) in zip(groups, PEERS, strict=False):
        means = part.groupby("setting").agg({"seconds": "median", "psnr_rgb": "mean"})
        means = means.sort_values("seconds")
        axis.plot(means.seconds, means.psnr_rgb, f"{marker}--", ms=5, color=color, label=name)
    count = points.gaussians.iloc[0]
    axis.set_title(
        f"{fr.counted(points.image)} of {points.set.iloc[0]},\n{count:,} Gaussians, 2 cores"
    )
    axis.title.set_fontsize(9)

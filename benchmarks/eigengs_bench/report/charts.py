"""What all charts share: files that two runs write alike, colours, axes; and charts of figures."""

from __future__ import annotations

import os
from base64 import b64encode
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from eigengs_bench.harness.tiling import tiling
from eigengs_bench.harness.timing import Image
from eigengs_dr.atomic import replacing

COLORS = {"default": "#0b6e99", "gaussianimage": "#b5442f", "eigengs": "#5a8f3c"}
"""Lines of the presets: told apart also where red and green look alike, by their lightness."""

INK = "#222222"

LOW_COLOR, HIGH_COLOR = "#d66014", "#1e5aa0"
"""Bars of the splats for low frequencies, and of all others, as in pictures of outlines."""

MAGNIFIED = 20
"""Factor by which the errors of tiles are shown."""


def new_figure(width: float, height: float) -> Figure:
    """Make an empty figure, sides in inches, that arranges its parts itself."""
    return Figure(figsize=(width, height), layout="constrained")  # not pyplot: it wants a screen


def save_figure(path: str | os.PathLike[str], figure: Figure) -> None:
    """Write a chart, whole or not at all; equal charts give equal files.

    Parameters
    ----------
    path : path-like
        Ends in .svg, .png or .pdf.
    figure : matplotlib.figure.Figure

    Raises
    ------
    ValueError
        If the suffix is another.
    OSError
        If the file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".svg", ".png", ".pdf"):
        raise ValueError(f"{path}: the name must end in .svg, .png or .pdf")
    with replacing(path) as temporary:
        temporary.write_bytes(drawn(figure, suffix[1:]))


def drawn(figure: Figure, kind: str = "svg") -> bytes:
    """Return the file of a chart."""
    # Names in an SVG file are else drawn at random.
    metadata: dict[str, Any] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    with rc_context({"svg.hashsalt": "eigengs_dr"}), BytesIO() as file:
        figure.savefig(file, format=kind, dpi=90, metadata=metadata.get(kind))
        return file.getvalue()


def data_uri(content: bytes, suffix: str) -> str:
    """Write a picture as a link that holds it; the suffix is .svg, .png or .jpg."""
    kind = {".svg": "svg+xml", ".jpg": "jpeg"}.get(suffix, suffix[1:])
    return f"data:image/{kind};base64,{b64encode(content).decode()}"


def logarithmic(axis: Axes, sides: str = "x", subs: Sequence[int] = (3,)) -> None:
    """Give axes logarithmic scales with plain numbers."""
    for side in sides:
        getattr(axis, f"set_{side}scale")("log", subs=list(subs))
        scale = getattr(axis, f"{side}axis")
        scale.set_major_formatter("{x:,g}")
        scale.set_minor_formatter("{x:,g}")


class Curve(NamedTuple):
    """A line of a chart: its name, and y over x."""

    name: str
    x: Sequence[float]
    y: Sequence[float]


class Radii(NamedTuple):
    """A panel of a histogram.

    Attributes
    ----------
    title : str
    low, high : ndarray of float, shape (N,)
        Radii in pixels of the splats for low frequencies (none where all serve all components), and
        of all others; of all images together.
    images : int
        How many.
    """

    title: str
    low: NDArray[Any]
    high: NDArray[Any]
    images: int


def curves_chart(panels: dict[str, list[Curve]], x_label: str, y_label: str) -> Figure:
    """Draw lines in the colours of the presets, one panel a title; all panels with equal names."""
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    figure = new_figure(3.2 * columns, 2.7 * rows + 0.5)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for axis, (title, curves) in zip(axes.flat, panels.items(), strict=False):
        for curve in curves:
            axis.plot(curve.x, curve.y, label=curve.name, color=COLORS.get(curve.name))
        axis.set_title(title, fontsize=10)
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(panels) :]:
        axis.set_axis_off()
    for axis in axes.flat[len(panels) - columns : len(panels)]:  # also with no panel below
        axis.tick_params(labelbottom=True)
    figure.supxlabel(x_label, fontsize=10)
    figure.supylabel(y_label, fontsize=10)
    handles = axes[0, 0].get_lines()
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), fontsize=9)
    return figure


def radii_chart(panels: Sequence[Radii]) -> Figure:
    """Draw histograms of radii side by side; numbers of splats on a logarithmic axis."""
    figure = new_figure(3.8 * len(panels), 3.2)
    axes = figure.subplots(1, len(panels), squeeze=False, sharex=True, sharey=True)[0]
    radii = np.concatenate([part for panel in panels for part in (panel.low, panel.high)])
    bins = np.linspace(0, 1.05 * radii.max(), 60)
    for axis, panel in zip(axes, panels, strict=True):
        for name, part, color in (
            ("high frequencies" if len(panel.low) else "all", panel.high, HIGH_COLOR),
            ("low frequencies", panel.low, LOW_COLOR),
        ):
            if len(part):
                weights = np.full(len(part), 1 / panel.images)
                label = f"{name}: {len(part) // panel.images:,} Gaussians"
                axis.hist(part, bins, weights=weights, color=color, alpha=0.8, label=label)
        axis.set(title=panel.title, yscale="log", xlabel="radius / pixels")
        axis.margins(y=0.35)  # room for the legend
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    axes[0].set_ylabel("Gaussians of an image")
    return figure


def tiles_chart(image: Image, pictures: dict[str, Image], side: int = 128) -> Figure:
    """Show the middle of pictures of one image, and below their errors magnified around mid-grey.

    Parameters
    ----------
    image : ndarray of float, shape (H, W, 3)
    pictures : dict of str to ndarray of float, shape (H, W, 3)
        By name, which stands above with its `tiling`.
    side : int, optional
        Pixels of a side of what is shown.
    """
    height, width = (min(side, length) for length in image.shape[:2])
    top, left = (image.shape[0] - height) // 2, (image.shape[1] - width) // 2
    part = np.s_[top : top + height, left : left + width]
    figure = new_figure(3.6 * len(pictures), 7.7)
    axes = figure.subplots(2, len(pictures), squeeze=False)
    for column, (name, picture) in zip(axes.T, pictures.items(), strict=True):
        column[0].set_title(f"{name}:\n{tiling(picture, image):.2f} levels of tiling")
        column[1].set_title(f"its errors times {MAGNIFIED}")
        error = 0.5 + MAGNIFIED * (picture - image)
        for axis, shown in zip(column, (picture, error), strict=True):
            axis.imshow(np.clip(shown[part], 0, 1), interpolation="nearest")
            axis.set_axis_off()
    return figure

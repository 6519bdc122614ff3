"""Charts: files that two runs write alike, colours and axes, and charts of pictures."""

import os
from base64 import b64encode
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eigengs_bench.harness.tiling import tiling
from eigengs_bench.harness.timing import Image
from eigengs_dr.storage.atomic import atomic_write

# Lines of the presets: told apart also where red and green look alike, by their lightness.
COLORS = {"default": "#0b6e99", "gaussianimage": "#b5442f", "eigengs": "#5a8f3c"}
INK = "#222222"

MAGNIFIED = 20  # factor by which the errors of tiles are shown


def new_figure(width: float, height: float, title: str = "") -> Figure:
    """Make an empty figure, sides in inches, that arranges its parts itself."""
    figure = Figure(figsize=(width, height), layout="constrained")  # not pyplot: no screen
    figure.suptitle(title) if title else None
    return figure


def save_figure(path: str | os.PathLike[str], figure: Figure) -> None:
    """Write a chart as .svg, .png or .pdf, whole or not at all."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(draw(figure, Path(path).suffix.lower()))


def draw(figure: Figure, suffix: str = ".svg") -> bytes:
    """Return the file of a chart; equal charts give equal files."""
    # Names in an SVG file are else drawn at random.
    metadata: dict[str, Any] = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
    with rc_context({"svg.hashsalt": "eigengs_dr"}), BytesIO() as file:
        figure.savefig(file, format=suffix[1:], dpi=90, metadata=metadata.get(suffix))
        return file.getvalue()


def data_uri(content: bytes, suffix: str) -> str:
    """Write a picture as a link that holds it; the suffix is .svg, .png or .jpg."""
    kind = {".svg": "svg+xml", ".jpg": "jpeg"}.get(suffix, suffix[1:])
    return f"data:image/{kind};base64,{b64encode(content).decode()}"


def label_axes(
    axis: Axes, x: str, y: str, logarithmic: str = "x", subs: Sequence[int] = (3,), **rest: Any
) -> None:
    """Name the axes, and give some of them logarithmic scales with plain numbers."""
    for side in logarithmic:
        getattr(axis, f"set_{side}scale")("log", subs=list(subs))
        getattr(axis, f"{side}axis").set_major_formatter("{x:,g}")
        getattr(axis, f"{side}axis").set_minor_formatter("{x:,g}")
    axis.set(xlabel=x, ylabel=y, **rest)
    axis.grid(alpha=0.3)


def curves_chart(
    panels: Mapping[str, Mapping[str, Sequence[float]]], x: Sequence[float], x_name: str, name: str
) -> Figure:
    """Draw lines in the colours of the presets, one panel a title, lines by preset."""
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    figure = new_figure(3.2 * columns, 2.7 * rows + 0.5)
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True).flatten()
    for axis, (title, curves) in zip(axes, panels.items(), strict=False):
        for preset, values in curves.items():
            axis.plot(x, values, label=preset, color=COLORS[preset])
        label_axes(axis, x_name, name, "", title=title)
    for axis in axes[len(panels) :]:
        axis.set_axis_off()
    handles = axes[0].get_lines()
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), fontsize=9)
    return figure


def radii_chart(panels: Mapping[str, Sequence[Any]]) -> Figure:
    """Draw histograms of radii in pixels side by side, on a logarithmic axis.

    A panel has the radii of the splats for low frequencies, shape (images, N), none where all serve
    all components, and those of all others.
    """
    figure = new_figure(3.8 * len(panels), 3.2)
    axes = figure.subplots(1, len(panels), squeeze=False, sharex=True, sharey=True)[0]
    bins = np.linspace(0, 1.05 * max(part.max() for _, part in panels.values()), 60)
    for axis, (title, (low, high)) in zip(axes, panels.items(), strict=True):
        name = "high frequencies" if low.size else "all"
        for part, label, color in ((high, name, "#1e5aa0"), (low, "low frequencies", "#d66014")):
            if part.size:
                style: Any = {"weights": np.full(part.size, 1 / len(part)), "color": color}
                label = f"{label}: {part.shape[1]:,} Gaussians"
                axis.hist(part.ravel(), bins, label=label, alpha=0.8, **style)
        axis.margins(y=0.35)  # room for the legend
        label_axes(axis, "radius / pixels", "Gaussians of an image", "", title=title, yscale="log")
        axis.legend(fontsize=8)
    return figure


def tiles_chart(image: Image, pictures: Mapping[str, Image], side: int = 128) -> Figure:
    """Show the middle of pictures of one image, and below their errors magnified around mid-grey.

    Pictures stand below their name and their `tiling`.
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

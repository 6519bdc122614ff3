"""Charts and strips of pictures: files that two runs write alike, colours and axes."""

import os
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image as pillow

from eigengs_bench.harness.tiling import tiling
from eigengs_bench.harness.timing import Image
from eigengs_dr.image.io import to_8bit
from eigengs_dr.image.resize import GAP, join_pictures, resample, text_line
from eigengs_dr.storage.atomic import atomic_write

# Lines of the presets, which differ in lightness too, for readers who confuse red and green.
COLORS = {"default": "#0b6e99", "gaussianimage": "#b5442f", "eigengs": "#5a8f3c"}
INK = "#222222"

MAGNIFIED = 20  # factor by which the errors of tiles are shown


def new_figure(width: float, height: float, title: str | None = None) -> Figure:
    """Make an empty figure, sides in inches, that arranges its parts itself."""
    figure = Figure(figsize=(width, height), layout="constrained")  # not pyplot: no screen
    figure.suptitle(title or "")
    return figure


def save_figure(path: Path, figure: Figure) -> None:
    """Write a chart as .svg, .png or .pdf, whole or not at all."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(draw(figure, path.suffix.lower()))


def draw(figure: Figure, suffix: str = ".svg") -> bytes:
    """Return the file of a chart; equal charts give equal SVG files."""
    # Names in an SVG file are else drawn at random.
    with rc_context({"svg.hashsalt": "eigengs_dr"}), BytesIO() as file:
        undated: Any = {"Date": None} if suffix == ".svg" else None
        figure.savefig(file, format=suffix[1:], dpi=90, metadata=undated)
        return file.getvalue()


def label_axes(
    axis: Axes, x: str, y: str, logarithmic: str = "x", legend: bool = True, **rest: Any
) -> None:
    """Name the axes, give some of them logarithmic scales with plain numbers, add a legend."""
    for side in logarithmic:
        getattr(axis, f"set_{side}scale")("log", subs=(2, 5))
        getattr(axis, f"{side}axis").set_major_formatter("{x:,g}")
        getattr(axis, f"{side}axis").set_minor_formatter("{x:,g}")
    axis.set(xlabel=x, ylabel=y, **rest)
    axis.grid(alpha=0.3)
    if legend:
        axis.legend(fontsize=8, framealpha=0.6)


def curves_chart(
    panels: Mapping[str, Mapping[str, Sequence[float]]], x: Sequence[float], x_name: str, name: str
) -> Figure:
    """Draw lines in the colours of the presets, one panel a title, lines by preset."""
    figure = new_figure(2.8 * len(panels) + 0.6, 3.2)
    axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    for axis, (title, curves) in zip(axes, panels.items(), strict=True):
        for preset, values in curves.items():
            axis.plot(x, values, label=preset, color=COLORS[preset])
        label_axes(axis, x_name, name, "", axis is axes[0], title=title)
    return figure


def radii_chart(panels: Mapping[str, Sequence[Any]]) -> Figure:
    """Draw histograms of radii in pixels side by side, on a logarithmic axis.

    A panel has the radii of the Gaussians for low frequencies, shape (images, N), none where all
    serve all components, and the radii of all others.
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
        error = 0.5 + MAGNIFIED * (picture - image)
        title = f"{name}:\n{tiling(picture, image):.2f} levels of tiling"
        titles = title, f"its errors times {MAGNIFIED}"
        for axis, shown, above in zip(column, (picture, error), titles, strict=True):
            axis.imshow(np.clip(shown[part], 0, 1), interpolation="nearest")
            axis.set_title(above)
            axis.set_axis_off()
    return figure


# Longer side of a picture, and heights of the letters below it and above a row, in pixels.
CELL, LETTERS, HEADING = 160, 13, 15

Picture = NDArray[Any]
Cell = tuple[str, Picture]  # the line below a picture, and the picture: RGB, not clamped


def strip(
    rows: Sequence[tuple[str, Sequence[Cell]]], credit: str = "", side: int = CELL, gap: int = GAP
) -> Picture:
    """Put rows of pictures below each other, each below its heading; RGB on white, not clamped."""
    drawn = []
    for heading, cells in rows:
        row = join_pictures([_cell(*cell, side) for cell in cells], 1, gap)
        above = [text_line(heading, row.shape[1], HEADING)] if heading else []
        drawn.append(join_pictures([*above, row], 0, 2))
    if credit:
        drawn.append(text_line(f"Images: {credit}", drawn[0].shape[1], LETTERS))
    return join_pictures(drawn, 0, gap)


def save_strip(path: str | os.PathLike[str], picture: Picture) -> None:
    """Write a strip, small: a .jpg of moderate quality, or a .png of 256 colours."""
    image = pillow.fromarray(to_8bit(picture).astype(np.uint8))
    with atomic_write(path) as temporary:
        if Path(path).suffix.lower() == ".png":
            image.quantize(256).save(temporary, optimize=True)
        else:
            image.save(temporary, quality=88)


def _cell(caption: str, picture: Picture, side: int) -> Picture:
    height, width = picture.shape[:2]
    scale = side / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    scaled = resample(np.clip(picture, 0, 1).astype(np.float32), *size)
    return join_pictures([scaled, text_line(caption, size[0], LETTERS)], 0, 0)

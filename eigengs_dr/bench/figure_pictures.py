"""Drawing of the paper's figures: strips of pictures with captions, and charts."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..image.io import to_8bit
from ..image.montage import join_pictures, text_line
from ..image.resize import resample
from ..storage.atomic import atomic_write
from .charts import COLORS, new_figure, save_figure

CELL = 160
"""Side of a picture in a strip, in pixels."""

LETTERS = 13
"""Height of letters below a picture, in pixels."""

HEADING = 15
"""Height of letters above a row."""

QUALITY = 88
"""Of JPEG files."""

PALETTE = 256
"""Colours of PNG files: photos in all their colours would make files of a megabyte."""

COLUMNS = 3
"""Panels side by side in a chart."""

LOW_COLOR, HIGH_COLOR = "#d66014", "#1e5aa0"
"""Bars of the splats for low frequencies, and of all others, as in pictures of outlines."""

Picture = NDArray[Any]
Color = tuple[int, int, int]


class Cell(NamedTuple):
    """A picture of a strip: RGB, shape (H, W, 3), not clamped, and the line below it."""

    caption: str
    picture: Picture


class Row(NamedTuple):
    """Pictures side by side, and the line above them."""

    heading: str
    cells: Sequence[Cell]


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


def strip(rows: Sequence[Row], credit: str = "", side: int = CELL) -> Picture:
    """Put rows of pictures below each other.

    Parameters
    ----------
    rows : sequence of Row
    credit : str, optional
        A last line: whose images these are.
    side : int, optional
        Longer side of a picture, in pixels.

    Returns
    -------
    ndarray of float, shape (H, W, 3)
        RGB on white, not clamped.
    """
    drawn = []
    for row in rows:
        cells = join_pictures([_cell(*cell, side) for cell in row.cells], 1)
        heading = [text_line(row.heading, cells.shape[1], HEADING)] if row.heading else []
        drawn.append(join_pictures([*heading, cells], 0, 2))
    if credit:
        drawn.append(text_line(f"Images: {credit}", drawn[0].shape[1], LETTERS))
    return join_pictures(drawn, 0)


def save_strip(path: str | os.PathLike[str], picture: Picture) -> None:
    """Write a strip, small: a JPEG of moderate quality, or a PNG of 256 colours.

    Parameters
    ----------
    path : path-like
        Ends in .jpg or .png.
    picture : ndarray of float, shape (H, W, 3)
        RGB, clamped.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    from PIL import Image

    image = Image.fromarray(to_8bit(picture).astype(np.uint8))
    with atomic_write(path) as temporary:
        if Path(path).suffix == ".png":
            image.quantize(PALETTE).save(temporary, optimize=True)
        else:
            image.save(temporary, quality=QUALITY)


def save_curves(
    path: str | os.PathLike[str], panels: dict[str, list[Curve]], x_label: str, y_label: str
) -> None:
    """Draw a line chart, one panel a title; lines have the colours of the presets.

    Parameters
    ----------
    path : path-like
        See `eigengs_dr.bench.charts.save_figure`.
    panels : dict of str to list of Curve
        At least one; all panels with the same names.
    x_label, y_label : str

    Raises
    ------
    ValueError
        If matplotlib is not installed, or the suffix unknown.
    OSError
        If the file cannot be written.
    """
    columns = min(COLUMNS, len(panels))
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
    save_figure(path, figure)


def save_radii(path: str | os.PathLike[str], panels: Sequence[Radii]) -> None:
    """Draw histograms of radii side by side; numbers of splats on a logarithmic axis.

    Parameters
    ----------
    path : path-like
        See `eigengs_dr.bench.charts.save_figure`.
    panels : sequence of Radii

    Raises
    ------
    ValueError
        If matplotlib is not installed, or the suffix unknown.
    OSError
        If the file cannot be written.
    """
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
        axis.set_title(panel.title, fontsize=10)
        axis.set_yscale("log")
        axis.margins(y=0.35)  # room for the legend
        axis.set_xlabel("radius / pixels")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    axes[0].set_ylabel("Gaussians of an image")
    save_figure(path, figure)


def _cell(caption: str, picture: Picture, side: int) -> Picture:
    """A picture above its line."""
    height, width = picture.shape[:2]
    scale = side / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    scaled = resample(np.clip(picture, 0, 1).astype(np.float32), *size)
    return join_pictures([scaled, text_line(caption, size[0], LETTERS)], 0, 0)

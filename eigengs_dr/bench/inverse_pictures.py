"""Charts and film strips of what `inverse` measured."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..image.color import to_coded
from ..image.montage import join_pictures, text_line
from ..image.resize import resample
from ..storage.atomic import atomic_write

if TYPE_CHECKING:
    from .inverse import Image, Result

TITLES = {
    "texels1024": "1,024 x 1,024 texels",
    "texels256": "256 x 256 texels",
    "gaussians": "Gaussians from grey",
    "coefficients": "coefficients",
    "both": "coefficients, then Gaussians",
}

CAPTIONS = {
    "cameras": "three cameras",
    "grazing": "one grazing, blurred camera",
    "hidden": "right half hidden",
    "noise": "noise: 4 samples a pixel",
}

CELL = 96
"""Side of a picture in a strip, in pixels."""

GAP = 4
"""White pixels between pictures."""


def save_chart(path: str | os.PathLike[str], results: dict[str, Result]) -> None:
    """Draw PSNR over steps and over seconds, a column a condition.

    Parameters
    ----------
    path : path-like
        Ends in .png, .svg or .pdf.
    results : dict of str to Result

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    from matplotlib.figure import Figure  # not pyplot, which looks for a screen

    figure = Figure(figsize=(3.2 * len(results), 5.6), layout="constrained")
    axes = figure.subplots(2, len(results), squeeze=False, sharey=True)
    for column, (name, result) in zip(axes.T, results.items(), strict=True):
        for method, trace in result.traces.items():
            column[0].plot(trace.steps, trace.psnr_ycbcr, label=TITLES[method])
            # The start, at 0 seconds, has no place on a logarithmic scale.
            column[1].plot(trace.seconds[1:], trace.psnr_ycbcr[1:])
        column[0].set_title(CAPTIONS[name], fontsize=10)
        column[0].set_xscale("symlog", linthresh=1)
        column[0].set_xlabel("steps")
        column[1].set_xscale("log")
        column[1].set_xlabel("seconds")
        for axis in column:
            axis.grid(alpha=0.3)
    for row in axes:
        row[0].set_ylabel("PSNR (YCbCr) / dB")
    lines = axes[0, 0].get_lines()
    figure.legend(handles=lines, loc="outside lower center", ncols=len(lines), fontsize=9)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format=Path(path).suffix[1:], dpi=90)


def strip(result: Result) -> Image:
    """Draw a condition's film strip: the photos, then a row a method, a column a step.

    Parameters
    ----------
    result : Result

    Returns
    -------
    ndarray of float32, shape (H, W, 3)
        RGB; every picture above its PSNR in YCbCr, the truth in a last column.
    """
    rows = [_photos(result)]
    for method, trace in result.traces.items():
        by_step = dict(zip(trace.steps, trace.psnr_ycbcr, strict=True))
        cells = [
            _captioned(f"{step}: {by_step[step]:.1f} dB", picture)
            for step, picture in trace.pictures.items()
        ]
        cells.append(_captioned("truth", result.truth))
        rows.append(_titled(TITLES[method], join_pictures(cells, 1, GAP)))
    return join_pictures(rows, 0, GAP).astype(np.float32)


def _photos(result: Result) -> Any:
    height, width = result.photos.shape[:2]
    coded = to_coded(result.photos.clip(0, 1))
    return _titled("photos", resample(coded, round(CELL * width / height), CELL))


def _captioned(text: str, picture: Any) -> Any:
    """A picture of a strip above a line of text."""
    return join_pictures([resample(picture, CELL, CELL), text_line(text, CELL)], 0, 0)


def _titled(text: str, row: Any) -> Any:
    return join_pictures([text_line(text, row.shape[1]), row], 0, 0)

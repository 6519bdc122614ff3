"""Table and chart of rate against distortion, from the rows that `eigengs_dr.bench.rate` made."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .budget_tables import smallest
from .charts import new_figure
from .rate import CODECS, OURS
from .rows import Row
from .table import MISSING, Table, median, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVELS = (28.0, 32.0, 36.0)
"""Decibels of PSNR in 8-bit RGB at which the sizes of files are compared."""

STYLES = {
    OURS: ("#0b6e99", "o-"),
    "JPEG 4:2:0": ("#c27c0e", "s--"),
    "JPEG 4:4:4": ("#b5442f", "D--"),
    "WebP": ("#5a8f3c", "^--"),
}
"""Colours and markers of the curves."""

Curve = list[Row]

Sizes = NDArray[np.float64]


def curves(rows: list[Row], name: str) -> dict[str, dict[str, Curve]]:
    """Gather the points of a set by codec and image, by their setting."""
    found: dict[str, dict[str, Curve]] = {title: {} for title in (OURS, *CODECS)}
    for row in rows:
        job = row["job"]
        if job["set"] == name:
            found[job["codec"]].setdefault(job["image"], []).extend(row["points"])
    for images in found.values():
        for points in images.values():
            points.sort(key=lambda point: point["setting"])
    return found


def rate_at(curve: Curve, level: float) -> float:
    """Interpolate the bits a pixel at a PSNR, the logarithm of the bits being linear in decibels.

    Between the first two neighbours, by their bits, that have the PSNR between them; NaN where the
    curve does not reach it.
    """
    return smallest({p["bits_per_pixel"]: _known(p["psnr_rgb"]) for p in curve}, level)


def _known(value: float | None) -> float:
    """A figure of a picture; NaN, null in the file, where a fit has failed."""
    return math.nan if value is None else value


def tables(rows: list[Row]) -> list[Table]:
    """Lay out the bits a pixel that each codec takes for as good a picture, a table a set.

    Means over the images that all codecs reach a PSNR on, in brackets over ours, and on how many
    images ours are fewer; and medians of the seconds to encode a point.
    """
    return [_table(rows, name) for name in dict.fromkeys(row["job"]["set"] for row in rows)]


def _table(rows: list[Row], name: str) -> Table:
    found = curves(rows, name)
    images = list(found[OURS])
    cells, counts = {title: list[str]() for title in found}, list[str]()
    for level in LEVELS:
        every = {
            title: np.array([rate_at(of_image[image], level) for image in images])
            for title, of_image in found.items()
        }
        reached = np.isfinite(list(every.values())).all(axis=0)
        counts.append(str(int(reached.sum())))
        sizes = {title: values[reached] for title, values in every.items()}
        for title, values in sizes.items():
            cells[title].append(_compared(values, sizes[OURS]))
    lines = [(title, *cells[title], median(_seconds(found[title]))) for title in found]
    lines.append(("images that all reach", *counts, MISSING))
    caption = (
        f"{name}, {len(images)} image{'s'[: len(images) > 1]}: bits a pixel for a PSNR in 8-bit "
        "RGB, interpolated; in brackets those of JPEG and WebP over ours, and on how many images "
        "ours are fewer\n(images that were JPEG files once suit JPEG)"
    )
    return Table(caption, ("codec", *(f"{level:g} dB" for level in LEVELS), "s"), lines)


def _compared(values: Sizes, ours: Sizes) -> str:
    """Mean bits a pixel; of another codec also over ours, and how often ours are fewer."""
    if not len(values):
        return MISSING
    mean = number(float(values.mean()), 2)
    if values is ours:
        return mean
    return f"{mean} ({values.mean() / ours.mean():.2f}, {np.sum(ours < values)})"


def _seconds(images: dict[str, Curve]) -> list[float]:
    return [point["seconds"] for curve in images.values() for point in curve]


def chart(rows: list[Row], name: str) -> Figure:
    """Draw PSNR in RGB and SSIM over bits a pixel: means over the images, a point a setting.

    Raises
    ------
    ValueError
        If matplotlib is not installed.
    """
    figure = new_figure(10, 4.8)
    images = len(curves(rows, name)[OURS])
    for axis, what, label in zip(
        figure.subplots(1, 2),
        ("psnr_rgb", "ssim"),
        ("PSNR in 8-bit RGB / dB", "SSIM"),
        strict=True,
    ):
        for title, of_image in curves(rows, name).items():
            # Fits have other numbers of splats on images of other sizes: the n-th are one point.
            settings = zip(*of_image.values(), strict=True)
            means = [
                [
                    float(np.mean([_known(p[key]) for p in points]))
                    for key in ("bits_per_pixel", what)
                ]
                for points in settings
            ]
            color, style = STYLES[title]
            axis.plot(*zip(*means, strict=True), style, color=color, ms=4, label=title)
        axis.set_xscale("log", subs=[2, 5])
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter("{x:g}")
        axis.set(xlabel="bits a pixel", ylabel=label)
        axis.grid(alpha=0.3)
    figure.axes[0].legend(fontsize=9)
    figure.suptitle(f"Rate against distortion: {name}, {images} image{'s'[: images > 1]}")
    return figure

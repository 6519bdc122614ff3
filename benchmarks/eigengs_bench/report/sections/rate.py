"""How many bytes a quality takes, from the rows that `rate` measured."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd
from matplotlib.figure import Figure

from eigengs_bench.experiments.rate import CODECS, OURS
from eigengs_bench.harness.store import Row
from eigengs_bench.report.charts import logarithmic, new_figure
from eigengs_bench.report.frames import (
    MISSING,
    Chart,
    Table,
    Told,
    counted,
    frame_of,
    number,
    quartiles,
    remark,
    smallest,
    table,
)

LEVELS = (28.0, 32.0, 36.0)
"""Decibels of PSNR in 8-bit RGB at which the sizes of files are compared."""

CODEC_STYLES = {
    OURS: ("#0b6e99", "o-"),
    "JPEG 4:2:0": ("#c27c0e", "s--"),
    "JPEG 4:4:4": ("#b5442f", "D--"),
    "WebP": ("#5a8f3c", "^--"),
}
"""Colours and markers of the curves."""


def tell(rows: Sequence[Row]) -> Told:
    """Lay out the bits a pixel that each codec takes for a PSNR: a table and a chart a set.

    Parameters
    ----------
    rows : sequence of dict
        Of `eigengs_bench.experiments.rate.run`.
    """
    points = frame_of(rows, "points")
    tables, charts = [], []
    for name, part in points.groupby("set", sort=False):
        tables.append(_table(str(name), part))
        caption = "Means over the images; fits of several numbers of Gaussians, packed."
        caption += remark(part.code)
        charts.append(Chart(f"rate-{name}", caption, _chart(part, str(name))))
    return Told(tables, charts)


def rates(points: pd.DataFrame) -> pd.DataFrame:
    """Interpolate the bits a pixel at `LEVELS`, a line an image, columns codec and level.

    NaN where a curve does not reach a level.
    """
    found = {}
    for (image, codec), part in points.groupby(["image", "codec"], sort=False):
        curve = dict(zip(part.bits_per_pixel, part.psnr_rgb, strict=True))
        for level in LEVELS:
            found[image, codec, level] = smallest(curve, level)
    return pd.Series(found).unstack([1, 2])


def _table(name: str, points: pd.DataFrame) -> Table:
    found, counts, means = rates(points), list[str](), {}
    for level in LEVELS:
        of_level = found.xs(level, axis=1, level=1).dropna()
        counts.append(str(len(of_level)))
        means[level] = of_level
    lines = [
        (
            codec,
            *(_compared(means[level], codec) for level in LEVELS),
            quartiles(points.seconds[points.codec == codec]),
        )
        for codec in (OURS, *CODECS)
    ]
    lines.append(("images that all reach", *counts, MISSING))
    caption = (
        f"{name}, {counted(points.image.nunique(), 'image')}: bits a pixel for a PSNR in 8-bit "
        "RGB, interpolated; in brackets those of JPEG and WebP over ours, and on how many images "
        "ours are fewer (images that were JPEG files once suit JPEG)"
    )
    columns = ("codec", *(f"{level:g} dB" for level in LEVELS), "s")
    return table(caption, columns, lines, points.code)


def _compared(sizes: pd.DataFrame, codec: str) -> str:
    """Mean bits a pixel; of another codec also over ours, and how often ours are fewer."""
    if sizes.empty:
        return MISSING
    mean = number(sizes[codec].mean(), 2)
    if codec == OURS:
        return mean
    fewer = int((sizes[OURS] < sizes[codec]).sum())
    return f"{mean} ({sizes[codec].mean() / sizes[OURS].mean():.2f}, {fewer})"


def _chart(points: pd.DataFrame, name: str) -> Figure:
    """Draw PSNR in RGB and SSIM over bits a pixel: means over the images, a point a setting."""
    figure = new_figure(10, 4.8)
    labels = {"psnr_rgb": "PSNR in 8-bit RGB / dB", "ssim": "SSIM"}
    points = points.sort_values("setting", kind="stable")
    # Fits have other numbers of splats on images of other sizes: the n-th are one point.
    rank = points.groupby(["codec", "image"]).cumcount()
    for axis, (what, label) in zip(figure.subplots(1, 2), labels.items(), strict=True):
        for codec, (color, style) in CODEC_STYLES.items():
            mine = points[points.codec == codec]
            means = mine.groupby(rank)[["bits_per_pixel", what]].agg(
                lambda values: values.mean(skipna=False)
            )
            axis.plot(*means.to_numpy().T, style, color=color, ms=4, label=codec)
        logarithmic(axis, "x", (2, 5))
        axis.set(xlabel="bits a pixel", ylabel=label)
        axis.grid(alpha=0.3)
    figure.axes[0].legend(fontsize=9)
    images = counted(points.image.nunique(), "image")
    figure.suptitle(f"Rate against distortion: {name}, {images}")
    return figure

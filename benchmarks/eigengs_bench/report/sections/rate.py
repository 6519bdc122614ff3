"""How many bytes a quality takes, from the rows that `rate` measured."""

from collections.abc import Sequence

import pandas as pd
from matplotlib.figure import Figure

from eigengs_bench.experiments.rate import OURS
from eigengs_bench.harness.store import Row
from eigengs_bench.report import frames as fr
from eigengs_bench.report.charts import label_axes, new_figure

# Decibels of PSNR in 8-bit RGB at which the sizes of files are compared.
LEVELS = (28.0, 32.0, 36.0)
STYLES = {  # colours and markers of the curves
    OURS: ("#0b6e99", "o-"),
    "JPEG 4:2:0": ("#c27c0e", "s--"),
    "JPEG 4:4:4": ("#b5442f", "D--"),
    "WebP": ("#5a8f3c", "^--"),
}
CAPTION = "Means over the images; fits of several numbers of Gaussians, packed."


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out the bits a pixel that each codec takes for a PSNR: a table and a chart a set."""
    tables, charts = [], {}
    for name, part in fr.frame_of(rows, "points").groupby("set", sort=False):
        tables.append(_table(str(name), part))
        charts[f"rate-{name}"] = CAPTION + fr.remark(part.code), _chart(part, str(name))
    return fr.Section(tables, charts)


def rates(points: pd.DataFrame, level: float) -> pd.DataFrame:
    """Interpolate bits a pixel at a PSNR: a line an image that all codecs reach it on."""
    found = {
        key: fr.smallest(dict(zip(part.bits_per_pixel, part.psnr_rgb, strict=True)), level)
        for key, part in points.groupby(["image", "codec"], sort=False)
    }
    return pd.Series(found).unstack().dropna()


def _table(name: str, points: pd.DataFrame) -> fr.Table:
    found = [rates(points, level) for level in LEVELS]
    lines = [
        (codec, *(_compared(sizes, codec) for sizes in found), fr.quartiles(part.seconds))
        for codec, part in points.groupby("codec", sort=False)
    ]
    lines.append(("images that all reach", *(str(len(sizes)) for sizes in found), fr.MISSING))
    caption = (
        f"{name}, {fr.counted(points.image)}: bits a pixel for a PSNR in 8-bit RGB, interpolated; "
        "in brackets the bits of JPEG and WebP over ours, and on how many images ours are fewer "
        "(images that were JPEG files once suit JPEG)"
    )
    columns = ("codec", *(f"{level:g} dB" for level in LEVELS), "s")
    return fr.table(caption, columns, lines, points.code)


def _compared(sizes: pd.DataFrame, codec: str) -> str:
    if sizes.empty:
        return fr.MISSING
    mean, ours = sizes[codec].mean(), sizes[OURS]
    ratio = f" ({mean / ours.mean():.2f}, {(ours < sizes[codec]).sum()})"
    return fr.number(mean, 2) + ratio * (codec != OURS)


def _chart(points: pd.DataFrame, name: str) -> Figure:
    """Draw PSNR in RGB and SSIM over bits a pixel: means over the images, a point a setting."""
    images = fr.counted(points.image)
    figure = new_figure(10, 4.8, f"Rate against distortion: {name}, {images}")
    points = points.sort_values("setting", kind="stable")
    # Fits have other numbers of Gaussians on images of other sizes: the n-th are one point.
    rank = points.groupby(["codec", "image"]).cumcount().rename("rank")
    means = points.groupby(["codec", rank])[["bits_per_pixel", "psnr_rgb", "ssim"]].mean()
    labels = {"psnr_rgb": "PSNR in 8-bit RGB / dB", "ssim": "SSIM"}
    for axis, (what, label) in zip(figure.subplots(1, 2), labels.items(), strict=True):
        for codec, (color, style) in STYLES.items():
            curve = means.loc[codec]
            axis.plot(curve.bits_per_pixel, curve[what], style, color=color, ms=4, label=codec)
        label_axes(axis, "bits a pixel", label)
    return figure

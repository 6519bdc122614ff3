"""How many bytes a quality takes, from the rows that `rate` measured."""

from collections.abc import Sequence
from importlib.resources import files

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.interpolate import PchipInterpolator

from eigengs_bench.experiments.rate import OURS
from eigengs_bench.harness.store import Row
from eigengs_bench.report import frames as fr
from eigengs_bench.report.charts import label_axes, new_figure

# Decibels of PSNR in 8-bit RGB at which the sizes of files are compared.
LEVELS = (28.95, 31.27, 32.0, 33.19, 36.0)
STYLES = {  # colours and markers of the curves
    OURS: ("#0b6e99", "o-"),
    "JPEG 4:2:0": ("#c27c0e", "s--"),
    "JPEG 4:4:4": ("#b5442f", "D--"),
    "JPEG 2000": ("#8a6d3b", "v--"),
    "WebP": ("#5a8f3c", "^--"),
    "AVIF": ("#7a4f9a", "x--"),
}
CAPTION = "Means over the images; fits of several numbers of Gaussians, packed."


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out the bits a pixel that each codec takes for a PSNR: a table and a chart a set."""
    tables, charts = [], {}
    for name, part in fr.frame_of(rows, "points").groupby("set", sort=False):
        tables.append(_table(str(name), part))
        tables += [_published(part)] if name == "kodak" else []
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
        (
            codec,
            *(_compared(sizes, codec) for sizes in found),
            _saved(points, codec),
            fr.quartiles(part.seconds),
            fr.quartiles(part.decode_seconds, 3),
        )
        for codec, part in points.groupby("codec", sort=False)
    ]
    reached = (str(len(sizes)) for sizes in found)
    lines.append(("images that all reach", *reached, *[fr.MISSING] * 3))
    caption = (
        f"{name}, {fr.counted(points.image)}: bits a pixel for a PSNR in 8-bit RGB, interpolated; "
        "in brackets the bits of a codec over ours, and on how many images ours are fewer "
        "(images that were JPEG files once suit JPEG). BD-rate: bits of ours at equal PSNR against "
        "the codec's, mean over the images"
    )
    columns = ("codec", *(f"{level:g} dB" for level in LEVELS), "BD-rate", "s", "s to decode")
    return fr.table(caption, columns, lines, points.code)


def bd_rate(ours: pd.DataFrame, other: pd.DataFrame) -> float:
    """Return the mean change of the bits at equal PSNR, from -1 on; NaN if no PSNR is of both.

    The logarithm of the bits is interpolated over the PSNR by monotone cubics (Bjontegaard,
    VCEG-M33; the cubics are those of later reference software).
    """
    curves = []
    for points in (ours, other):
        best = points.sort_values("bits_per_pixel")
        best = best[best.psnr_rgb > best.psnr_rgb.cummax().shift(fill_value=-np.inf)]
        if len(best) < 2:
            return float("nan")
        curves.append(PchipInterpolator(best.psnr_rgb, np.log(best.bits_per_pixel)))
    low, high = (f(*(ends(c.x) for c in curves)) for f, ends in ((max, min), (min, max)))
    if low >= high:
        return float("nan")
    mine, others = (curve.integrate(low, high) / (high - low) for curve in curves)
    return float(np.exp(mine - others) - 1)


def _saved(points: pd.DataFrame, codec: str) -> str:
    """Write the BD-rate of ours against a codec."""
    if codec == OURS:
        return fr.MISSING
    parts = [part.groupby("codec") for _, part in points.groupby("image", sort=False)]
    both = [p for p in parts if {OURS, codec} <= set(p.groups)]
    found = pd.Series([bd_rate(p.get_group(OURS), p.get_group(codec)) for p in both], dtype=float)
    return fr.MISSING if found.isna().all() else f"{100 * found.mean():+.0f} %"


def _published(points: pd.DataFrame) -> fr.Table:
    """Lay out the BD-rate of the means of ours against published figures."""
    known = pd.read_csv(str(files("eigengs_bench.report") / "published_rate.csv"))
    ours = points[points.codec == OURS].sort_values("setting", kind="stable")
    rank = ours.groupby("image").cumcount()
    means = ours.groupby(rank)[["bits_per_pixel", "psnr_rgb"]].mean()
    lines = [
        (name, f"{100 * bd_rate(means, part):+.1f} %", part.source.iloc[0])
        for name, part in known.groupby("method", sort=False)
    ]
    caption = f"kodak, {fr.counted(points.image)}: BD-rate of the mean curve against published ones"
    return fr.table(caption, ("method", "BD-rate of ours", "source"), lines, points.code)


def _compared(sizes: pd.DataFrame, codec: str) -> str:
    if sizes.empty:
        return fr.MISSING
    mean, ours = sizes[codec].mean(), sizes[OURS]
    ratio = f" ({mean / ours.mean():.2f}, {(ours < sizes[codec]).sum()})"
    return fr.number(mean, 2) + ratio * (codec != OURS)


def _chart(points: pd.DataFrame, name: str) -> Figure:
    """Draw PSNR in RGB and MS-SSIM over bits a pixel: means over the images, a point a setting."""
    images = fr.counted(points.image)
    figure = new_figure(10, 4.8, f"Rate against distortion: {name}, {images}")
    points = points.sort_values("setting", kind="stable")
    # Fits have other numbers of Gaussians on images of other sizes: the n-th are one point.
    rank = points.groupby(["codec", "image"]).cumcount().rename("rank")
    means = points.groupby(["codec", rank])[["bits_per_pixel", "psnr_rgb", "ms_ssim"]].mean()
    labels = {"psnr_rgb": "PSNR in 8-bit RGB / dB", "ms_ssim": "MS-SSIM"}
    for axis, (what, label) in zip(figure.subplots(1, 2), labels.items(), strict=True):
        for codec, (color, style) in STYLES.items():
            curve = means.loc[codec]
            axis.plot(curve.bits_per_pixel, curve[what], style, color=color, ms=4, label=codec)
        label_axes(axis, "bits a pixel", label)
    return figure

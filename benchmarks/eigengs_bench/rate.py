"""Rate against distortion: packed fits beside the codecs of Pillow, and published means.

A row has "points": setting (the number of Gaussians, or the quality), bytes, bits_per_pixel, the
figures of `judge`, seconds of encoding and decode_seconds.
"""

import io
import time
from collections.abc import Iterator, Sequence
from functools import partial
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image as pillow
from scipy.interpolate import PchipInterpolator

import eigengs_dr as eg
from eigengs_bench import report as fr
from eigengs_bench.clock import Image, judge, warm_up
from eigengs_bench.images import images_of
from eigengs_bench.rows import Job, Row, Task
from eigengs_dr.image.io import to_8bit

OURS = "packed Gaussians"
PIXELS = (256, 128, 64, 32, 16, 8)  # pixels per Gaussian of the fits that are packed
# Decibels that packing may lose: of some numbers below it and some above,
# these had the best PSNR at equal size on training photos, by little.
BUDGET = 0.8
QUALITIES = (2, 5, 10, 15, 20, 30, 40, 50, 60, 70, 80, 85, 90, 95)
RATIOS = (200, 120, 80, 60, 48, 40, 32, 26, 20, 16, 13, 10, 8, 6)
# Decibels of PSNR in 8-bit RGB at which the sizes of files are compared.
LEVELS = (28.95, 31.27, 32.0, 33.19, 36.0)
# Slopes at which means are compared with published ones: the fall of the mean squared error, with
# 255 as white, for one more bit per pixel.
SLOPES = np.geomspace(1000, 10, 13)


class Codec(NamedTuple):
    """A codec: Pillow's name and options for a slow, good setting of the encoder; its line.

    The settings are qualities, or ratios of the sizes of the pixels and the file.
    """

    kind: str
    options: dict[str, Any]
    color: str
    style: str
    settings: tuple[int, ...] = QUALITIES

    def set_to(self, setting: int) -> dict[str, Any]:
        """Return the options for writing a file with a setting."""
        if self.kind == "JPEG2000":
            return {**self.options, "quality_mode": "rates", "quality_layers": [setting]}
        return {**self.options, "quality": setting}


# 4:4:4 and the tuning for PSNR are 0.1 to 0.5 dB better than AVIF's defaults. Slower settings take
# up to 20 s per photo, for 1 % more bits at equal PSNR.
AVIF = {"speed": 4, "max_threads": 1, "subsampling": "4:4:4", "advanced": {"tune": "psnr"}}
CODECS = {
    "JPEG 4:2:0": Codec("JPEG", {"optimize": True, "subsampling": 2}, fr.ORANGE, "s--"),
    "JPEG 4:4:4": Codec("JPEG", {"optimize": True, "subsampling": 0}, fr.RED, "D--"),
    "JPEG 2000": Codec("JPEG2000", {"irreversible": True, "mct": 1}, fr.GREY, "v--", RATIOS),
    "WebP": Codec("WEBP", {"method": 6}, fr.GREEN, "^--"),
    "AVIF 4:4:4": Codec("AVIF", AVIF, fr.PINK, "x--"),
    "JPEG XL": Codec("JXL", {"effort": 7}, fr.SKY, "P--"),
}
import_module("pillow_jxl")  # Pillow knows JPEG XL from then on


def run(task: Task, names: Sequence[str]) -> list[Row]:
    """Measure a packed fit of each size, and the codecs, on each image."""
    jobs = [job for name in names for job in _jobs(task, name, images_of(task, name))]
    return task.measure("rate", jobs)


def _jobs(task: Task, name: str, images: list[tuple[str, Image]]) -> Iterator[Job]:
    settings = {"iterations": task.iterations, "budget": BUDGET}
    for photo, image in images:
        about = {"set": name, "image": photo}
        for pixels in PIXELS:
            count = max(1, image.shape[0] * image.shape[1] // pixels)
            label = {**about, "codec": OURS, "gaussians": count, **settings}
            yield label, partial(_packed, task, image, count)
        for title, codec in CODECS.items():
            yield {**about, "codec": title}, partial(_coded, image, codec)


def _packed(task: Task, image: Image, count: int) -> Row:
    """Pack a fit; `seconds` are those of both."""
    warm_up(image, task.iterations, gaussians=count, backend=task.backend)
    with TemporaryDirectory() as folder:
        path, started = Path(folder) / "fit.egs", time.perf_counter()
        result = eg.fit(image, count, task.iterations, backend=task.backend, progress=False)
        size = eg.pack(result.gaussians, path, image, BUDGET).bytes
        seconds = time.perf_counter() - started
        eg.picture_of(eg.Gaussians.load(path, task.backend))  # compiles
        started = time.perf_counter()
        picture = eg.picture_of(eg.Gaussians.load(path, task.backend))
        times = {"seconds": seconds, "decode_seconds": time.perf_counter() - started}
    return {"points": [_point(count, size, picture, image) | times]}


def _coded(image: Image, codec: Codec) -> Row:
    source, points = pillow.fromarray(to_8bit(image).astype(np.uint8)), []
    for setting in codec.settings:
        file = io.BytesIO()
        started = time.perf_counter()
        source.save(file, codec.kind, **codec.set_to(setting))
        coded = time.perf_counter()
        pixels = np.asarray(pillow.open(file).convert("RGB"))
        seconds = {"seconds": coded - started, "decode_seconds": time.perf_counter() - coded}
        picture = pixels.astype(np.float32) / 255
        points.append(_point(setting, len(file.getvalue()), picture, image) | seconds)
    return {"points": points}


def _point(setting: int, size: int, picture: NDArray[Any], image: Image) -> Row:
    bits = 8 * size / (image.shape[0] * image.shape[1])
    return {"setting": setting, "bytes": size, "bits_per_pixel": bits, **judge(picture, image)}


# ---------------------------------------------------------------------------------------------
#  Tables and charts
# ---------------------------------------------------------------------------------------------


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out the bits per pixel that each codec takes for a PSNR: a table and a chart per set."""
    tables, charts, figures = [], {}, {}
    for name, part in fr.frame_of(rows, "points").groupby("set", sort=False):
        tables.append(_table(str(name), part))
        tables += [_published(part)] if name == "kodak" else []
        charts[f"rate-{name}"] = _chart(part, str(name))
        figures[f"{name}_avif"] = _share(part, "AVIF 4:4:4")
    return fr.Section(tables, charts, figures)


def rates(points: pd.DataFrame, level: float) -> pd.DataFrame:
    """Interpolate bits per pixel at a PSNR: a line for each image on which all codecs reach it."""
    bits = {
        key: fr.smallest(dict(zip(part.bits_per_pixel, part.psnr_rgb, strict=True)), level)
        for key, part in points.groupby(["image", "codec"], sort=False)
    }
    return pd.Series(bits).unstack().dropna()


def _table(name: str, points: pd.DataFrame) -> fr.Table:
    by_level = [rates(points, level) for level in LEVELS]
    lines = [
        (
            codec,
            *(fr.mean(sizes[codec], 2) for sizes in by_level),
            _saved(points, codec),
            fr.median(part.seconds),
            fr.median(part.decode_seconds, 3),
        )
        for codec, part in points.groupby("codec", sort=False)
    ]
    reached = (str(len(sizes)) for sizes in by_level)
    lines.append(("images that all reach", *reached, *[fr.MISSING] * 3))
    caption = (
        f"{name}, {fr.counted(points.image)}: bits per pixel for a PSNR in 8-bit RGB, interpolated"
        "; BD-rate: bits of ours at equal PSNR against the codec's, mean over the images"
    )
    columns = ("codec", *(f"{level:g} dB" for level in LEVELS), "BD-rate", "s", "s to decode")
    return fr.table(caption, columns, lines, name)


def bd_rate(ours: pd.DataFrame, other: pd.DataFrame) -> float:
    """Return the mean change of the bits at equal PSNR, above -1; NaN if the PSNRs do not overlap.

    The logarithm of the bits is interpolated over the PSNR by monotone cubics (Bjontegaard,
    VCEG-M33; the cubics are those of later reference software).
    """
    curves = []
    for points in (ours, other):
        best = fr.best(points, "bits_per_pixel")
        if len(best) < 2:
            return float("nan")
        curves.append(PchipInterpolator(best.psnr_rgb, np.log(best.bits_per_pixel)))
    low, high = (f(*(ends(c.x) for c in curves)) for f, ends in ((max, min), (min, max)))
    if low >= high:
        return float("nan")
    mine, others = (curve.integrate(low, high) / (high - low) for curve in curves)
    return float(np.exp(mine - others) - 1)


def _change(points: pd.DataFrame, codec: str) -> float:
    """Return the mean BD-rate of ours against a codec over the images; NaN if there is none."""
    parts = [part.groupby("codec") for _, part in points.groupby("image", sort=False)]
    both = [p for p in parts if {OURS, codec} <= set(p.groups)]
    changes = [bd_rate(p.get_group(OURS), p.get_group(codec)) for p in both]
    return float(pd.Series(changes, dtype=float).mean())


def _saved(points: pd.DataFrame, codec: str) -> str:
    """Write the BD-rate of ours against a codec."""
    change = float("nan") if codec == OURS else _change(points, codec)
    return fr.MISSING if np.isnan(change) else f"{100 * change:+.0f} %"


def _share(points: pd.DataFrame, codec: str) -> str:
    """Write the bytes of ours in per cent of those of a codec."""
    return f"{fr.number(100 + 100 * _change(points, codec), 0)} %"


def at_equal_slope(points: pd.DataFrame) -> pd.DataFrame:
    """Return means over the images: at each slope, the best point of every image.

    The published means are over equal settings of an encoder, or about equal slopes. Means at equal
    numbers of Gaussians would treat easy and hard images alike, and flatter by about 0.5 dB.
    """
    error = 255**2 * 10 ** (-points.psnr_rgb / 10)
    chosen = []
    for slope in SLOPES:
        cost = error + slope * points.bits_per_pixel
        best = points.loc[cost.groupby(points.image).idxmin()]
        chosen.append(best[["bits_per_pixel", "psnr_rgb"]].mean())
    return pd.DataFrame(chosen).drop_duplicates()


def _published(points: pd.DataFrame) -> fr.Table:
    """Lay out the BD-rate of the means of ours and of the codecs against published means."""
    published = pd.read_csv(str(files("eigengs_bench") / "published_rate.csv"))
    ours = at_equal_slope(points[points.codec == OURS])
    lines = [
        (name, f"{100 * bd_rate(ours, part):+.0f} %", part.source.iloc[0])
        for name, part in published.groupby("method", sort=False)
    ]
    caption = (
        f"kodak, {fr.counted(points.image)}: BD-rate of our mean curve at equal slope, against "
        "published mean curves (of CompressAI: results/image/kodak); above 0 ours takes more bits"
    )
    columns = ("method", "BD-rate of ours", "source")
    return fr.table(caption, columns, lines, "published")


def _chart(points: pd.DataFrame, name: str) -> Figure:
    """Draw PSNR in RGB and MS-SSIM over bits per pixel: means over images, a point per setting."""
    images = fr.counted(points.image)
    figure = fr.new_figure(8, 4.2, f"Rate against distortion: {name}, {images}")
    points = points.sort_values("setting", kind="stable")
    # Numbers of Gaussians differ between image sizes: the n-th of each size form one point.
    rank = points.groupby(["codec", "image"]).cumcount().rename("rank")
    means = points.groupby(["codec", rank])[["bits_per_pixel", "psnr_rgb", "ms_ssim"]].mean()
    styles = {OURS: (fr.BLUE, "o-")} | {k: (c.color, c.style) for k, c in CODECS.items()}
    labels = {"psnr_rgb": "PSNR in RGB / dB", "ms_ssim": "MS-SSIM"}
    for axis, (what, label) in zip(figure.subplots(1, 2), labels.items(), strict=True):
        for codec, (color, style) in styles.items():
            if codec in means.index:
                curve = means.loc[codec]
                axis.plot(curve.bits_per_pixel, curve[what], style, color=color, ms=4, label=codec)
        fr.label_axes(axis, "bits per pixel", label, legend=False)
    fr.legend_below(figure, axis, 4)
    return figure

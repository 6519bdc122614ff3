"""The rows of `tables` as the paper prints them, with the figures that the paper prints.

Tai et al., "EigenGS Representation", CVPR 2025: tables 1 (FFHQ), 2 (transfer) and 3 (ablation).
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import pandas as pd

from eigengs_bench.experiments.tables import Method, methods
from eigengs_bench.harness.store import Row
from eigengs_bench.names import NATURAL, SETS
from eigengs_bench.report import frames as fr

STEPS = ("images", "method", "0", "100", "500", "1,000", "5,000", "10,000")

# Rows of tables 1 and 2, by the set of ours that comes closest.
PRINTED = {
    "cats512": (
        STEPS,
        [
            ("FFHQ, 512x512", "GaussianImage", "-", "10.4", "21.8", "29.4", "39.2", "40.1"),
            ("FFHQ, 512x512", "EigenGS, 300", "28.0", "34.4", "36.4", "37.5", "40.7", "41.8"),
            ("FFHQ, 512x512", "EigenGS, 500", "28.9", "34.8", "36.7", "37.7", "40.8", "41.8"),
        ],
    ),
    "faces256": (
        STEPS,
        [
            ("CelebA, 256x256", "GaussianImage", "-", "10.3", "21.9", "30.0", "43.8", "45.2"),
            ("CelebA, 256x256", "of cats", "28.2", "36.2", "40.7", "43.2", "47.2", "48.2"),
            ("CelebA, 256x256", "of ImageNet", "28.7", "35.4", "39.6", "42.2", "46.3", "47.3"),
        ],
    ),
    "cats256": (
        STEPS,
        [("Cats, 256x256", "of ImageNet", "29.6", "37.6", "41.1", "42.9", "45.9", "46.6")],
    ),
}
# Rows of table 3, after 10,000 steps.
ABLATION = (
    ("fitted in", "split", "CelebA", "FFHQ", "Cats", "Cars"),
    [
        ("ycbcr", "split", "47.2", "41.8", "45.7", "44.7"),
        ("ycbcr", "whole", "48.0", "40.7", "46.1", "43.5"),
        ("rgb", "split", "39.5", "34.9", "38.5", "36.4"),
        ("rgb", "whole", "39.9", "33.3", "38.9", "35.1"),
    ],
)


def _seconds(values: pd.Series) -> str:
    """Median of the time, to the millisecond where it is short."""
    return fr.quartiles(values, 3 if values.max() < 0.1 else 2)


def _percent_above(limit: float, values: pd.Series) -> str:
    return fr.number(100 * (values > limit).mean(), 0)


# Lines of a method: their figures, and what writes a cell of the values of all images.
LINES: dict[str, tuple[str, Callable[[pd.Series], str]]] = {
    "PSNR YCbCr / dB": ("psnr_ycbcr", fr.spread),
    "PSNR RGB / dB": ("psnr_rgb", fr.spread),
    "SSIM": ("ssim", partial(fr.spread, decimals=3)),
    "MS-SSIM": ("ms_ssim", partial(fr.spread, decimals=3)),
    "seconds": ("seconds", _seconds),
    "% above 35 dB YCbCr": ("psnr_ycbcr", partial(_percent_above, 35)),
    "% above 40 dB YCbCr": ("psnr_ycbcr", partial(_percent_above, 40)),
}
# Titles and lines of tables; the paper compares each fit in the space it was made in.
KINDS = {
    "main": ("Methods", list(LINES)),
    "cross": ("Bases of other images", ["PSNR YCbCr / dB", "MS-SSIM", "% above 40 dB YCbCr"]),
    "ablation": ("Colour space and split", ["PSNR YCbCr / dB", "PSNR RGB / dB", "MS-SSIM"]),
}
REACHES = {
    "images": ("share", lambda values: f"{values.count()} of {len(values)}"),
    "seconds": ("seconds", partial(fr.quartiles, decimals=3)),
    "share of its time": ("share", partial(fr.quartiles, decimals=4)),
    "largest share": ("share", lambda values: fr.number(values.max(), 4)),
}


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Make all tables that rows are enough for.

    All sets at a glance; for each set and number of steps the `KINDS`; the paper's figures; and how
    soon "default" has what "gaussianimage" has at the end.
    """
    groups = groups_of(fr.frame_of(rows, "moments"))
    tables, printed = list(_glances(groups)), dict[str, Any]()
    for (name, iterations), fits in groups.items():
        for kind, (title, lines) in KINDS.items():
            chosen = methods_of(fits, name, kind)
            if chosen.method.nunique() > 1:
                where = f"{_images(name, chosen)}, {iterations:,} steps"
                tables.append(_over_steps(f"{title}: {where}", chosen, lines))
                printed |= {name: PRINTED[name]} if kind == "main" and name in PRINTED else {}
                printed |= {kind: ABLATION} if kind == "ablation" else {}
    for name, figures in printed.items():
        tables.append(fr.table(f"What the paper prints, like {name}: PSNR / dB", *figures))
    if len(reached := fr.frame_of(row for row in rows if "share" in row)):
        reached["its steps"] = reached.iterations.map("{:,}".format)
        caption = "Time until default has the PSNR of gaussianimage at its last step"
        tables.append(fr.grouped(caption, reached, ["set", "its steps"], REACHES))
    return fr.Section(tables)


def groups_of(fits: pd.DataFrame) -> dict[Any, pd.DataFrame]:
    """Gather the fits of each set and number of steps."""
    return dict(iter(fits.groupby(["set", "iterations"], sort=False))) if len(fits) else {}


def methods_of(fits: pd.DataFrame, name: str, kind: str) -> pd.DataFrame:
    """Choose the fits of a table of a set, in the order of its methods, a column "method"."""
    labels = {method: label(method, name) for method in methods(name, kind, list(SETS))}
    keys = fits[list(Method._fields)].itertuples(index=False, name=None)
    chosen = fits.assign(method=[labels.get(Method(*key)) for key in keys])
    order = list(labels.values())
    chosen = chosen.dropna(subset="method")
    return chosen.sort_values("method", key=lambda names: names.map(order.index), kind="stable")


def label(method: Method, name: str) -> str:
    """Name of a method on a set, for a reader."""
    if not method.source:
        return method.preset
    basis = {NATURAL: "universal", name: "own"}.get(method.source, method.source)
    text = f"{method.preset}, {method.components} components, {basis} basis"
    return text if method.split == "auto" else f"{method.preset}, {method.space}, {method.split}"


def _glances(groups: dict[Any, pd.DataFrame]) -> Iterator[fr.Table]:
    """One line a set and method: means of the PSNR over steps, and the time of all of them."""
    for length in sorted({steps for _, steps in groups}):
        parts = [methods_of(f, name, "main") for (name, own), f in groups.items() if own == length]
        fits = pd.concat(parts)
        columns: dict[str, Any] = {"images": ("image", lambda values: str(values.nunique()))}
        for step in sorted(fits.iteration.unique()):
            columns[f"{step:,}"] = "psnr_ycbcr", _at(fits.iteration == step, fr.mean)
        columns["seconds"] = "seconds", _at(fits.iteration == length, _seconds)
        caption = f"PSNR YCbCr / dB by steps, means over images, and seconds of {length:,} steps"
        if len(fits):
            yield fr.grouped(caption, fits, ["set", "method"], columns)


def _at(step: pd.Series, write: Callable[[pd.Series], str]) -> Callable[[pd.Series], str]:
    return lambda values: write(values[step[values.index]])


def _images(name: str, fits: pd.DataFrame) -> str:
    chosen, counts = SETS[name], fits.groupby("method").image.nunique()
    least = f"{counts.min()} to " if counts.min() < counts.max() else ""
    size = f"{chosen.width}x{chosen.height}, {chosen.gaussians:,} Gaussians"
    return f"{name}, {least}{fr.counted(fits.image)} of {size}"


def _over_steps(caption: str, fits: pd.DataFrame, lines: Sequence[str]) -> fr.Table:
    groups = fits.groupby(["method", "iteration"])
    cells = {line: groups[LINES[line][0]].agg(LINES[line][1]).unstack() for line in lines}
    order = pd.MultiIndex.from_product([fits.method.unique(), lines], names=["method", "figure"])
    texts = pd.concat(cells).swaplevel().reindex(order).fillna(fr.MISSING)
    texts.columns = [f"{step:,}" for step in texts]
    return fr.Table(caption + fr.remark(fits.code), texts.reset_index())

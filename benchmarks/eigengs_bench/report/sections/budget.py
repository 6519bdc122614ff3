"""How many Gaussians a PSNR takes, from the rows that `budget` measured."""

from collections.abc import Sequence
from functools import partial
from itertools import cycle
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from eigengs_bench.harness.store import Row
from eigengs_bench.report import frames as fr
from eigengs_bench.report.charts import INK, label_axes, new_figure

# Colours and markers of the targets, in turn.
STYLES = (("#c27c0e", "^"), ("#0b6e99", "o"), ("#8a4f9e", "s"), ("#5a8f3c", "D"))
CAPTION = "Every point is an image and a target: Gaussians found over the smallest number."

FIT = ["set", "image", "gaussians"]
SAVINGS = {
    "fixed": ("least", partial(fr.quartiles, decimals=0)),
    "found": ("enough", partial(fr.quartiles, decimals=0)),
    "% fewer": ("saving", lambda values: fr.number(values.median(), 0)),
    "range": ("saving", partial(fr.extent, decimals=0)),
    "images": ("saving", lambda values: str(values.count())),
    "% met": ("met", lambda values: f"{100 * values.mean():.0f}"),
    "s": ("seconds", fr.quartiles),
    "over a fit": ("ratio", fr.quartiles),
    "fit, dB": ("fit_psnr", lambda values: fr.number(values.median(skipna=False), 2)),
}
GAINS = {
    "images": ("image", lambda values: str(len(values))),
    "gain, dB": ("gain", lambda values: fr.number(values.median(), 2)),
    "range": ("gain", fr.extent),
    "s, once": ("seconds_once", fr.quartiles),
    "s, anew": ("seconds", fr.quartiles),
}


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out how many Gaussians a PSNR takes: a table and a chart a set, and one of the starts."""
    fits = fr.frame_of(row for row in rows if "rearranged" in row["job"])
    searches = fr.frame_of(row for row in rows if "target" in row["job"])
    if fits.empty or searches.empty:
        return fr.Section()
    tables, charts = [], {}
    for name, part in points_of(fits, searches).groupby("set", sort=False):
        caption = (
            f"{name}, {fr.counted(part.image)}: the smallest fixed number of Gaussians for a PSNR "
            "in YCbCr, placed once, and the number that the search finds; seconds of the search, "
            "also over the seconds of a default fit of this number, and the PSNR of this fit"
        )
        part, both = part.assign(PSNR=part.target.map("{:g} dB".format)), part.saving.notna()
        part = part.assign(least=part.fixed.where(both), enough=part.found.where(both))
        tables.append(fr.grouped(caption, part, ["PSNR"], SAVINGS))
        charts[f"budget-{name}"] = CAPTION + fr.remark(part.code), _chart(part, str(name))
    pairs = gains(fits, searches)
    pairs["Gaussians"] = pairs.gaussians.map("{:,}".format)
    pairs["gain"] = pairs.psnr_ycbcr - pairs.psnr_ycbcr_once
    caption = "One number of Gaussians, placed once, and also placed anew: gain of PSNR in YCbCr"
    return fr.Section([*tables, fr.grouped(caption, pairs, ["set", "Gaussians"], GAINS)], charts)


def points_of(fits: pd.DataFrame, searches: pd.DataFrame) -> pd.DataFrame:
    """Gather the targets of all images, in the order of the searches.

    "fixed" is the `smallest` number of Gaussians placed once that reaches a target, "found" that of
    the search; fit_psnr and fit_seconds are of a default fit of as many. "saving" is in per cent,
    NaN where one of both does not reach the target; "ratio" is of the seconds.
    """
    anew = fits.rearranged.astype(bool)
    once = {
        key: dict(zip(part.gaussians, part.psnr_ycbcr, strict=True))
        for key, part in fits[~anew].groupby(FIT[:2])
    }
    same = fits[anew].drop_duplicates(FIT)[[*FIT, "psnr_ycbcr", "seconds"]]
    same = same.rename(columns={"psnr_ycbcr": "fit_psnr", "seconds": "fit_seconds"})
    # A search without its fit is of an image at which a run stopped.
    points = searches.merge(same, on=FIT).rename(columns={"gaussians": "found"})
    keys = zip(points.set, points.image, points.target, strict=True)
    points["fixed"] = [fr.smallest(once.get((name, image), {}), goal) for name, image, goal in keys]
    points["met"] = points.stopped == "met"
    points["saving"] = (100 * (1 - points.found / points.fixed)).where(points.met)
    points["ratio"] = points.seconds / points.fit_seconds
    return points


def gains(fits: pd.DataFrame, searches: pd.DataFrame) -> pd.DataFrame:
    """Pair fits of one number of Gaussians, placed once (columns in "_once") and placed anew.

    The number is the one of which most images of a set have pairs, searches aside.
    """
    fits = fits.drop_duplicates([*FIT, "rearranged"], keep="last")
    anew = fits.rearranged.astype(bool)
    pairs = fits[~anew].merge(fits[anew], on=FIT, suffixes=("_once", ""))
    sought = pairs.merge(searches[FIT].drop_duplicates(), on=FIT, how="left", indicator="from")
    pairs = pairs[(sought["from"] == "left_only").to_numpy()]
    sizes = pairs.groupby(["set", "gaussians"], as_index=False).size()
    best = sizes.sort_values(["size", "gaussians"]).drop_duplicates("set", keep="last")
    return pairs.merge(best[["set", "gaussians"]], on=["set", "gaussians"])


def _chart(points: pd.DataFrame, name: str) -> Figure:
    figure = new_figure(6.4, 6, f"No more than needed: {name}; below the line is better")
    axis = figure.subplots()
    styles = zip(points.groupby("target", sort=False), cycle(STYLES), strict=False)
    for (target, some), (color, marker) in styles:
        label = f"{target:g} dB, {some.saving.count()} of {fr.counted(some.image)}"
        both = some.dropna(subset="saving")
        axis.plot(both.fixed, both.found, marker, color=color, ms=5, alpha=0.8, label=label)
    sizes = points.dropna(subset="saving")[["fixed", "found"]].to_numpy()
    ends = (sizes.min() / 1.3, sizes.max() * 1.3) if len(sizes) else (1.0, 10.0)
    axis.plot(ends, ends, color=INK, lw=1, label="as many")
    x = "smallest fixed number for a PSNR in YCbCr, Gaussians placed once"
    equal: Any = {"xlim": ends, "ylim": ends, "aspect": "equal"}
    label_axes(axis, x, "Gaussians that the search finds", "xy", **equal)
    return figure

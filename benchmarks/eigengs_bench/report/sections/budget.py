"""How many Gaussians a PSNR takes, from the rows that `budget` measured."""

from collections.abc import Sequence
from itertools import cycle

import pandas as pd
from matplotlib.figure import Figure

from eigengs_bench.harness.store import Row
from eigengs_bench.report import frames as fr
from eigengs_bench.report.charts import INK, label_axes, new_figure
from eigengs_bench.report.frames import Told

# Colours and markers of the targets, in turn.
STYLES = (("#c27c0e", "^"), ("#0b6e99", "o"), ("#8a4f9e", "s"), ("#5a8f3c", "D"))
CAPTION = "Every point is an image and a target: Gaussians found over the smallest number."

FIT = ["set", "image", "gaussians"]


def tell(rows: Sequence[Row]) -> Told:
    """Lay out how many Gaussians a PSNR takes: a table and a chart a set, and one of the starts."""
    fits = fr.frame_of(row for row in rows if "rearranged" in row["job"])
    searches = fr.frame_of(row for row in rows if "target" in row["job"])
    tables, charts, drawn = [], {}, {}
    if len(fits) and len(searches):
        for name, part in points_of(fits, searches).groupby("set", sort=False):
            tables.append(_savings(name, part))
            charts[f"budget-{name}"] = CAPTION + fr.remark(part.code), _chart(part, name)
            drawn[f"budget-{name}"] = part.drop(columns="code")
        tables.append(_gains(gains(fits, searches)))
    return Told(tables, charts, drawn)


def points_of(fits: pd.DataFrame, searches: pd.DataFrame) -> pd.DataFrame:
    """Gather the targets of all images, in the order in which they were searched for.

    "fixed" is the `smallest` number of splats placed once that reaches a target, "found" that of
    the search; fit_psnr and fit_seconds are of a default fit of as many. "saving" is in per cent,
    NaN where one of both does not reach the target; "ratio" is of the seconds.
    """
    once = {
        key: dict(zip(part.gaussians, part.psnr_ycbcr, strict=True))
        for key, part in fits[~fits.rearranged.astype(bool)].groupby(FIT[:2])
    }
    anew = fits[fits.rearranged.astype(bool)].drop_duplicates(FIT)
    same = anew[[*FIT, "psnr_ycbcr", "seconds"]]
    same = same.rename(columns={"psnr_ycbcr": "fit_psnr", "seconds": "fit_seconds"})
    # A search without its fit is of an image that a run was stopped at.
    points = searches.merge(same, on=FIT).rename(columns={"gaussians": "found"})
    keys = zip(points.set, points.image, points.target, strict=True)
    points["fixed"] = [fr.smallest(once.get((name, image), {}), goal) for name, image, goal in keys]
    points["met"] = points.stopped == "met"
    points["saving"] = (100 * (1 - points.found / points.fixed)).where(points.met)
    points["ratio"] = points.seconds / points.fit_seconds
    return points


def _savings(name: str, points: pd.DataFrame) -> fr.Table:
    lines = []
    for target, some in points.groupby("target", sort=False):
        both = some.dropna(subset="saving")
        cells = [fr.quartiles(both.fixed, 0), fr.quartiles(both.found, 0), *fr.span(both.saving, 0)]
        cells += [str(len(both)), f"{100 * some.met.mean():.0f}", fr.quartiles(some.seconds)]
        cells += [fr.quartiles(some.ratio), fr.number(some.fit_psnr.median(skipna=False), 2)]
        lines.append((f"{target:g} dB", *cells))
    caption = (
        f"{name}, {fr.counted(points.image.nunique())}: the smallest fixed number of splats for a "
        "PSNR in YCbCr, placed once, and what the search finds; seconds of the search, also over "
        "those of a default fit of as many, and what that fit reaches"
    )
    columns = ("PSNR", "fixed", "found", "% fewer", "range", "images", "% met", "s", "over a fit")
    return fr.table(caption, (*columns, "fit, dB"), lines, points.code)


def gains(fits: pd.DataFrame, searches: pd.DataFrame) -> pd.DataFrame:
    """Pair fits of one number of splats, placed once (columns in "_once") and placed anew.

    The number is that which most images of a set have such pairs of, but not for a search.
    """
    fits = fits.drop_duplicates([*FIT, "rearranged"], keep="last")
    anew = fits.rearranged.astype(bool)
    pairs = fits[~anew].merge(fits[anew], on=FIT, suffixes=("_once", ""))
    sought = pairs.merge(searches[FIT].drop_duplicates(), on=FIT, how="left", indicator="from")
    pairs = pairs[(sought["from"] == "left_only").to_numpy()]
    sizes = pairs.groupby(["set", "gaussians"], as_index=False).size()
    best = sizes.sort_values(["size", "gaussians"]).drop_duplicates("set", keep="last")
    return pairs.merge(best[["set", "gaussians"]], on=["set", "gaussians"])


def _gains(pairs: pd.DataFrame) -> fr.Table:
    lines = []
    for name, part in pairs.groupby("set", sort=False):
        cells = [f"{part.gaussians.iloc[0]:,}", str(len(part))]
        cells += [*fr.span(part.psnr_ycbcr - part.psnr_ycbcr_once, 2)]
        lines.append((name, *cells, fr.quartiles(part.seconds_once), fr.quartiles(part.seconds)))
    caption = "As many splats placed once, and placed anew on the way: gain in dB of PSNR in YCbCr"
    columns = ("set", "splats", "images", "gain, dB", "range", "s, once", "s, anew")
    return fr.table(caption, columns, lines, [*pairs.code, *pairs.code_once])


def _chart(points: pd.DataFrame, name: str) -> Figure:
    """Draw splats found over splats of the smallest fixed number, a point an image and target."""
    figure = new_figure(6.4, 6, f"No more than needed: {name}; below the line is better")
    axis, known = figure.subplots(), points.dropna(subset="saving")
    styles = zip(points.groupby("target", sort=False), cycle(STYLES), strict=False)
    for (target, some), (color, marker) in styles:
        both = some.dropna(subset="saving")
        label = f"{target:g} dB, {len(both)} of {fr.counted(len(some))}"
        axis.plot(both.fixed, both.found, marker, color=color, ms=5, alpha=0.8, label=label)
    ends = (1.0, 10.0)
    if len(known):
        ends = (
            known[["fixed", "found"]].min().min() / 1.3,
            known[["fixed", "found"]].max().max() * 1.3,
        )
    axis.plot(ends, ends, color=INK, lw=1, label="as many")
    x = "smallest fixed number for a PSNR in YCbCr, Gaussians placed once"
    y, equal = "Gaussians that the search finds", {"xlim": ends, "ylim": ends, "aspect": "equal"}
    label_axes(axis, x, y, "xy", (2, 5), **equal)
    axis.legend(fontsize=9)
    return figure

"""How many Gaussians a PSNR takes, from the rows that `budget` measured."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle

import pandas as pd
from matplotlib.figure import Figure

from eigengs_bench.harness.store import Row
from eigengs_bench.report.charts import INK, logarithmic, new_figure
from eigengs_bench.report.frames import (
    Chart,
    Table,
    Told,
    counted,
    frame_of,
    number,
    quartiles,
    remark,
    smallest,
    span,
    table,
)

TARGET_STYLES = (("#c27c0e", "^"), ("#0b6e99", "o"), ("#8a4f9e", "s"), ("#5a8f3c", "D"))
"""Colours and markers of the targets, in turn."""


def tell(rows: Sequence[Row]) -> Told:
    """Lay out how many Gaussians a PSNR takes: a table and a chart a set, and one of the starts.

    Parameters
    ----------
    rows : sequence of dict
        Of `eigengs_bench.experiments.budget.run`.
    """
    fits = frame_of(row for row in rows if "rearranged" in row["job"])
    searches = frame_of(row for row in rows if "target" in row["job"])
    points = searched_points(fits, searches)
    tables, charts, drawn = [], [], {}
    for name, part in points.groupby("set", sort=False) if len(points) else ():
        tables.append(_savings(str(name), part))
        caption = "Every point is an image and a target: Gaussians found over the smallest number."
        caption += remark(part.code)
        charts.append(Chart(f"budget-{name}", caption, _chart(part, str(name))))
        drawn[f"budget-{name}"] = part.drop(columns="code")
    if len(fits):
        tables.append(_gains(fits, searches))
    return Told(tables, charts, drawn)


def searched_points(fits: pd.DataFrame, searches: pd.DataFrame) -> pd.DataFrame:
    """Gather the targets of all images, in the order in which they were searched for.

    Returns
    -------
    DataFrame
        set, image, target; fixed, the `smallest` number of splats placed once that reaches it;
        found, met, psnr, seconds and iterations of the search; fit_psnr and fit_seconds of a
        default fit of as many; saving, per cent fewer than the fixed number, NaN where one of them
        does not reach the target; ratio, seconds of the search over those of the fit.
    """
    if fits.empty or searches.empty:
        return pd.DataFrame()
    fits = fits.drop_duplicates(["set", "image", "gaussians", "rearranged"])
    once = {
        key: dict(zip(part.gaussians, part.psnr_ycbcr, strict=True))
        for key, part in fits[~fits.rearranged.astype(bool)].groupby(["set", "image"])
    }
    anew = fits[fits.rearranged.astype(bool)]
    same = anew[["set", "image", "gaussians", "psnr_ycbcr", "seconds"]]
    # A search without its fit is of an image that a run was stopped at.
    found = searches.merge(same, on=["set", "image", "gaussians"], suffixes=("", "_fit"))
    keys = zip(found.set, found.image, found.target, strict=True)
    points = pd.DataFrame(
        {
            "set": found.set,
            "image": found.image,
            "target": found.target,
            "fixed": [smallest(once.get((name, image), {}), goal) for name, image, goal in keys],
            "found": found.gaussians,
            "met": found.stopped == "met",
            "psnr": found.psnr_ycbcr,
            "seconds": found.seconds,
            "iterations": found.iterations,
            "fit_psnr": found.psnr_ycbcr_fit,
            "fit_seconds": found.seconds_fit,
            "code": found.code,
        }
    )
    saving = 100 * (1 - points.found / points.fixed)
    return points.assign(saving=saving.where(points.met), ratio=points.seconds / points.fit_seconds)


def _savings(name: str, points: pd.DataFrame) -> Table:
    lines = []
    for target, some in points.groupby("target", sort=False):
        both = some.dropna(subset="saving")
        lines.append(
            (
                f"{target:g} dB",
                quartiles(both.fixed, 0),
                quartiles(both.found, 0),
                *span(both.saving, 0),
                str(len(both)),
                f"{100 * some.met.mean():.0f}",
                quartiles(some.seconds),
                quartiles(some.ratio),
                number(some.fit_psnr.median(skipna=False), 2),
            )
        )
    caption = (
        f"{name}, {counted(points.image.nunique(), 'image')}: the smallest fixed number of splats "
        "for a PSNR in YCbCr, placed once, and what the search finds; seconds of the search, also "
        "over those of a default fit of as many, and what that fit reaches"
    )
    columns = ("PSNR", "fixed", "found", "% fewer", "range", "images", "% met", "s", "over a fit")
    return table(caption, (*columns, "fit, dB"), lines, points.code)


def gains(fits: pd.DataFrame, searches: pd.DataFrame) -> pd.DataFrame:
    """Pair fits of one number of splats, placed once and placed anew.

    The number is that which most images of a set have such pairs of, but not for a search. Columns
    of the first end in "_once".
    """
    key = ["set", "image", "gaussians"]
    fits = fits.drop_duplicates([*key, "rearranged"])
    anew = fits.rearranged.astype(bool)
    pairs = fits[~anew].merge(fits[anew], on=key, suffixes=("_once", ""))
    if len(searches):
        sought = set(searches[key].itertuples(index=False, name=None))
        own = [tuple(line) not in sought for line in pairs[key].itertuples(index=False, name=None)]
        pairs = pairs[own]
    sizes = pairs.groupby(["set", "gaussians"]).size().rename("pairs").reset_index()
    best = sizes.sort_values(["pairs", "gaussians"]).drop_duplicates("set", keep="last")
    return pairs.merge(best[["set", "gaussians"]], on=["set", "gaussians"])


def _gains(fits: pd.DataFrame, searches: pd.DataFrame) -> Table:
    pairs = gains(fits, searches)
    lines = [
        (
            name,
            f"{part.gaussians.iloc[0]:,}",
            str(len(part)),
            *span(part.psnr_ycbcr - part.psnr_ycbcr_once, 2),
            quartiles(part.seconds_once),
            quartiles(part.seconds),
        )
        for name, part in pairs.groupby("set", sort=False)
    ]
    caption = "as many splats placed once, and placed anew on the way: gain in dB of PSNR in YCbCr"
    columns = ("set", "splats", "images", "gain, dB", "range", "s, once", "s, anew")
    return table(caption, columns, lines, [*pairs.code, *pairs.code_once])


def _chart(points: pd.DataFrame, name: str) -> Figure:
    """Draw splats found over splats of the smallest fixed number, a point an image and target."""
    figure = new_figure(6.4, 6)
    axis = figure.subplots()
    styles = cycle(TARGET_STYLES)
    for (target, some), (color, marker) in zip(
        points.groupby("target", sort=False), styles, strict=False
    ):
        both = some.dropna(subset="saving")
        label = f"{target:g} dB, {len(both)} of {counted(len(some), 'image')}"
        axis.plot(both.fixed, both.found, marker, color=color, ms=5, alpha=0.8, label=label)
    known = points.dropna(subset="saving")[["fixed", "found"]].to_numpy()
    ends = (known.min() / 1.3, known.max() * 1.3) if len(known) else (1, 10)
    axis.plot(ends, ends, color=INK, lw=1, label="as many")
    logarithmic(axis, "xy", (2, 5))
    axis.set(xlim=ends, ylim=ends, aspect="equal")
    axis.tick_params(which="both", labelsize=8.5)
    axis.set_xlabel("smallest fixed number for a PSNR in YCbCr, Gaussians placed once")
    axis.set_ylabel("Gaussians that the search finds")
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=9)
    figure.suptitle(f"No more than needed: {name}; below the line is better")
    return figure

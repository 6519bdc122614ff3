"""Tables and charts of how many splats are needed, from rows of `eigengs_dr.bench.budget`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .budget import reached
from .charts import new_figure
from .rows import Row
from .table import MISSING, Table, median, number, save_csv

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLES = (("#c27c0e", "^"), ("#0b6e99", "o"), ("#8a4f9e", "s"), ("#5a8f3c", "D"))
"""Colours and markers of the targets, in turn."""

INK = "#222222"


class Point(NamedTuple):
    """A target on an image; PSNRs are psnr_ycbcr in decibels.

    Attributes
    ----------
    set, image : str
    target : float
    fixed : float
        Splats of the smallest fixed number that reaches it, see `smallest`.
    found : int
        Splats of the search.
    met : bool
        Whether they reach it.
    psnr, seconds : float
        Of the search.
    iterations : int
        Steps of the search.
    fit_psnr, fit_seconds : float
        Of a default fit of as many splats as were found.
    """

    set: str
    image: str
    target: float
    fixed: float
    found: int
    met: bool
    psnr: float
    seconds: float
    iterations: int
    fit_psnr: float
    fit_seconds: float

    @property
    def saving(self) -> float:
        """Per cent fewer splats than the fixed number; NaN where one of them does not reach it."""
        return 100 * (1 - self.found / self.fixed) if self.met else math.nan

    @property
    def ratio(self) -> float:
        """Seconds of the search over those of a fit of as many splats."""
        return self.seconds / self.fit_seconds


def points(rows: Sequence[Row]) -> list[Point]:
    """Gather the targets of all images, in the order in which they were searched for."""
    fits = {_key(row): row for row in rows if "rearranged" in row["job"]}
    found = []
    for row in rows:
        job = row["job"]
        if "target" not in job:
            continue
        curve = {
            count: reached(fitted)
            for (name, image, count, rearranged), fitted in fits.items()
            if (name, image, rearranged) == (job["set"], job["image"], False)
        }
        same = fits.get((job["set"], job["image"], row["gaussians"], True))
        if same is None:  # of an image that a run was stopped at
            continue
        found.append(
            Point(
                job["set"],
                job["image"],
                job["target"],
                smallest(curve, job["target"]),
                row["gaussians"],
                row["stopped"] == "met",
                reached(row),
                row["seconds"],
                row["iterations"],
                reached(same),
                same["seconds"],
            )
        )
    return found


def _key(row: Row) -> tuple[str, str, int, bool]:
    job = row["job"]
    return job["set"], job["image"], job["gaussians"], job["rearranged"]


def smallest(curve: Mapping[Any, float], target: float) -> float:
    """Interpolate the size at a PSNR, which is taken as linear in the logarithm of the size.

    Between the first two neighbours, by their sizes (splats, or bits), that have the PSNR between
    them; NaN where there are none.
    """
    for (few, low), (many, high) in pairwise(sorted(curve.items())):
        if low <= target <= high:
            share = (target - low) / (high - low) if high > low else 0.0
            return float(few * (many / few) ** share)
    return math.nan


def gains(rows: Sequence[Row]) -> dict[str, list[tuple[Row, Row]]]:
    """Pairs of fits of one number, placed once and placed anew, by set.

    The number is that which most images of a set have such pairs of, but not for a search.
    """
    fits = {_key(row): row for row in rows if "rearranged" in row["job"]}
    found = {
        (row["job"]["set"], row["job"]["image"], row["gaussians"])
        for row in rows
        if "target" in row["job"]
    }
    pairs: dict[str, dict[int, list[tuple[Row, Row]]]] = {}
    for (name, image, count, rearranged), anew in fits.items():
        once = fits.get((name, image, count, False))
        if rearranged and once is not None and (name, image, count) not in found:
            pairs.setdefault(name, {}).setdefault(count, []).append((once, anew))
    return {
        name: max(counts.items(), key=lambda item: (len(item[1]), item[0]))[1]
        for name, counts in pairs.items()
    }


def tables(rows: Sequence[Row]) -> list[Table]:
    """Lay out what was measured: a table a set, a line a target; and one of the starts.

    Counts, seconds and ratios are medians with the middle half, savings and gains medians with the
    range. A saving is there for images on which both the search and a fixed number reach the
    target.
    """
    drawn = points(rows)
    found = [_savings(drawn, name) for name in dict.fromkeys(p.set for p in drawn)]
    return [*found, _gains(rows)]


def _savings(drawn: Sequence[Point], name: str) -> Table:
    mine = [p for p in drawn if p.set == name]
    images = len({p.image for p in mine})
    lines = []
    for target in dict.fromkeys(p.target for p in mine):
        some = [p for p in mine if p.target == target]
        both = [p for p in some if math.isfinite(p.saving)]
        lines.append(
            (
                f"{target:g} dB",
                median([p.fixed for p in both], 0),
                median([p.found for p in both], 0),
                *ranged([p.saving for p in both], 0),
                str(len(both)),
                f"{100 * np.mean([p.met for p in some]):.0f}",
                median([p.seconds for p in some]),
                median([p.ratio for p in some]),
                number(float(np.median([p.fit_psnr for p in some])), 2),
            )
        )
    caption = (
        f"{name}, {images} image{'s'[: images > 1]}: the smallest fixed number of splats for a "
        "PSNR in YCbCr, placed once, and what the search finds;\nseconds of the search, also over "
        "those of a default fit of as many, and what that fit reaches"
    )
    columns = ("PSNR", "fixed", "found", "% fewer", "range", "images", "% met", "s", "over a fit")
    return Table(caption, (*columns, "fit, dB"), lines)


def _gains(rows: Sequence[Row]) -> Table:
    lines = [
        (
            name,
            f"{pairs[-1][0]['job']['gaussians']:,}",
            str(len(pairs)),
            *ranged([reached(anew) - reached(once) for once, anew in pairs], 2),
            median([once["seconds"] for once, _ in pairs]),
            median([anew["seconds"] for _, anew in pairs]),
        )
        for name, pairs in gains(rows).items()
    ]
    caption = "as many splats placed once, and placed anew on the way: gain in dB of PSNR in YCbCr"
    columns = ("set", "splats", "images", "gain, dB", "range", "s, once", "s, anew")
    return Table(caption, columns, lines)


def ranged(values: Sequence[float], decimals: int) -> tuple[str, str]:
    """Write the median of values, and the least and the greatest: "37" and "12 to 55"."""
    if not values:
        return MISSING, MISSING
    ends = " to ".join(number(end, decimals) for end in (min(values), max(values)))
    return number(float(np.median(values)), decimals), ends


def save_points(path: Path, drawn: Sequence[Point]) -> None:
    """Write the points of a chart as CSV; a cell is empty where a figure is not there.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    lines = ([*p, p.saving, p.ratio] for p in drawn)
    known = (["" if cell != cell else cell for cell in line] for line in lines)
    save_csv(path, [*Point._fields, "saving", "ratio"], known)


def chart(drawn: Sequence[Point], name: str) -> Figure:
    """Draw splats found over splats of the smallest fixed number, a point an image and target.

    Parameters
    ----------
    drawn : sequence of Point
        Those of one set; what misses its target is left out, and told by the legend.
    name : str
        The set, for the title.

    Raises
    ------
    ValueError
        If matplotlib is not installed.
    """
    figure = new_figure(6.4, 6)
    axis = figure.subplots()
    targets = dict.fromkeys(p.target for p in drawn)
    for target, (color, marker) in zip(targets, cycle(STYLES), strict=False):
        some = [p for p in drawn if p.target == target]
        both = [p for p in some if math.isfinite(p.saving)]
        label = f"{target:g} dB, {len(both)} of {len(some)} images"
        x, y = [p.fixed for p in both], [p.found for p in both]
        axis.plot(x, y, marker, color=color, ms=5, alpha=0.8, label=label)
    known = [n for p in drawn if math.isfinite(p.saving) for n in (p.fixed, p.found)]
    ends = (min(known) / 1.3, max(known) * 1.3) if known else (1, 10)
    axis.plot(ends, ends, color=INK, lw=1, label="as many")
    axis.set_xscale("log", subs=[2, 5])
    axis.set_yscale("log", subs=[2, 5])
    axis.set(xlim=ends, ylim=ends, aspect="equal")
    for side in (axis.xaxis, axis.yaxis):
        side.set_major_formatter("{x:,.0f}")
        side.set_minor_formatter("{x:,.0f}")
    axis.tick_params(which="both", labelsize=8.5)
    axis.set_xlabel("smallest fixed number for a PSNR in YCbCr, Gaussians placed once")
    axis.set_ylabel("Gaussians that the search finds")
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=9)
    figure.suptitle(f"No more than needed: {name}; below the line is better")
    return figure

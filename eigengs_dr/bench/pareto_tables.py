"""Points and tables of speed against accuracy, from the rows that `pareto` measured."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .pareto import WIDE, front
from .rows import Row
from .table import MISSING, Table, median, number, save_csv, spread

FIGURES = ("seconds", "psnr_ycbcr", "psnr_rgb", "psnr_wide")
"""What is measured of every fit and image."""

UNCUT = f"YCbCr at {WIDE:g} sigma"
"""Column of the PSNR of splats that are shown as if they were not cut off."""


class Point(NamedTuple):
    """A variant after some steps on the images of a set: a value of each figure an image.

    Attributes
    ----------
    knob : str
    value : str or float
    iteration : int
    gaussians : int
    seconds, psnr_ycbcr, psnr_rgb, psnr_wide : list of float
        NaN where a fit has failed.
    front, front_same : bool
        Whether `place` is on the Pareto front of all points of the set, and on that of those with
        as many Gaussians as the default fit.
    """

    knob: str
    value: str | float
    iteration: int
    gaussians: int
    seconds: list[float]
    psnr_ycbcr: list[float]
    psnr_rgb: list[float]
    psnr_wide: list[float]
    front: bool = False
    front_same: bool = False

    @property
    def place(self) -> tuple[float, float]:
        """Median of the seconds and mean of the PSNR in YCbCr: where charts show the point."""
        return float(np.median(self.seconds)), float(np.mean(self.psnr_ycbcr))


def sets_of(rows: Iterable[Row]) -> list[str]:
    """Names of the sets that fits were measured on."""
    return list(dict.fromkeys(row["job"]["set"] for row in rows if "trace" in row))


def points(rows: Iterable[Row], name: str) -> list[Point]:
    """Gather the images of a set, and find the fronts.

    Parameters
    ----------
    rows : iterable of dict
        Of `eigengs_dr.bench.pareto.jobs`.
    name : str
        The set.
    """
    found: dict[tuple[Any, ...], Point] = {}
    for row in rows:
        job = row["job"]
        for figures in row.get("trace", []) if job["set"] == name else []:
            key = (job["knob"], job["value"], figures["iteration"], row["gaussians"])
            point = found.setdefault(key, Point(*key, [], [], [], []))
            for figure in FIGURES:
                value = figures[figure]
                getattr(point, figure).append(np.nan if value is None else value)
    same = _same(list(found.values()))
    fronts = [set(front([p.place for p in some])) for some in (found.values(), same)]
    return [
        p._replace(front=p.place in fronts[0], front_same=p in same and p.place in fronts[1])
        for p in found.values()
    ]


def _same(drawn: list[Point]) -> list[Point]:
    """Points with as many Gaussians as the default fit."""
    counts = {p.gaussians for p in drawn if p.value == "default"}
    return [p for p in drawn if p.gaussians in counts]


def save_points(path: Path, drawn: list[Point]) -> None:
    """Write the points of a chart as CSV, with columns of 0 and 1 for the two fronts.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    lines = []
    for p in drawn:
        psnrs = [float(np.mean(getattr(p, column))) for column in FIGURES[1:]]
        figures = [p.place[0], *psnrs, len(p.seconds), int(p.front), int(p.front_same)]
        lines.append([*p[:4], *figures])
    save_csv(path, [*Point._fields[:4], *FIGURES, "images", *Point._fields[-2:]], lines)


def tables(rows: list[Row]) -> list[Table]:
    """Lay out what was measured: a table a set, one of storage, one of the renderer.

    Returns
    -------
    list of Table
        Of a set, a row a variant: seconds and PSNR after all steps (medians with the middle half,
        means with standard deviation), and after which numbers of steps it is on the
        front of all fits, and on that of those with as many Gaussians.
    """
    found = [_variants_table(rows, name) for name in sets_of(rows)]
    if any("stored" in row for row in rows):
        found.append(_storage_table(rows))
    return found + [_kernels_table(row["kernels"]) for row in rows if "kernels" in row]


def _variants_table(rows: list[Row], name: str) -> Table:
    drawn = points(rows, name)
    steps, images = max(p.iteration for p in drawn), len(drawn[0].seconds)
    lines = []
    for last in (p for p in drawn if p.iteration == steps):
        same = [p for p in drawn if (p.knob, p.value) == (last.knob, last.value)]
        first = min(same, key=lambda p: p.iteration)
        lines.append(
            (
                f"{last.knob} {text_of(last.value)}",
                median(first.seconds, 3),
                spread(first.psnr_ycbcr),
                median(last.seconds),
                spread(last.psnr_ycbcr),
                spread(last.psnr_rgb),
                spread(last.psnr_wide),
                ", ".join(text_of(p.iteration) for p in same if p.front) or MISSING,
                ", ".join(text_of(p.iteration) for p in same if p.front_same) or MISSING,
            )
        )
    caption = (
        f"{name}, {images} image{'s'[: images > 1]}: seconds and PSNR at the start and after "
        f"{steps:,} steps; after how many steps\na fit is on the front of all fits, and of those "
        "with as many Gaussians; settings not named are the default ones"
    )
    start, fronts = ("s, start", "YCbCr, start"), ("on front", "as many")
    columns = ("fit", *start, "s", "YCbCr", "RGB", UNCUT, *fronts)
    return Table(caption, columns, lines)


def _storage_table(rows: list[Row]) -> Table:
    lines = [
        (
            f"{name} {precision}",
            number(kept[0]["bytes"] / 1024),
            spread([row["psnr_ycbcr"] for row in kept]),
            spread([row["psnr_rgb"] for row in kept]),
        )
        for name, forms in stored_by_set(rows).items()
        for precision, kept in forms.items()
    ]
    columns = ("stored as", "KiB", "YCbCr", "RGB")
    return Table("the default fits, stored in fewer bits a parameter: PSNR", columns, lines)


def _kernels_table(kernels: list[Row]) -> Table:
    lines = [
        (
            f"{row['renderer']} {row['cutoff']:g}",
            number(row["forward_ms"], 2),
            number(row["step_ms"], 2),
            f"{row['largest_error']:.1e}",
            f"{row['rms_error']:.1e}",
        )
        for row in sorted(kernels, key=lambda row: row["renderer"])
    ]
    columns = ("cutoff", "forward, ms", "and reverse, ms", "largest error", "RMS error")
    return Table("the renderer, and what its cutoff leaves out of a picture", columns, lines)


def stored_by_set(rows: list[Row]) -> dict[str, dict[str, list[Row]]]:
    """Figures of every set and precision, one an image."""
    found: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        for figures in row.get("stored", []):
            forms = found.setdefault(row["job"]["set"], {})
            forms.setdefault(figures["precision"], []).append(figures)
    return found


def text_of(value: str | float) -> str:
    """Write a value of a knob."""
    return value if isinstance(value, str) else f"{value:,g}" if value % 1 else f"{value:,.0f}"

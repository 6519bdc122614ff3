"""What levels of detail are worth: PSNR over how many splats of a set are drawn."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..fitting.density_control import removal_cost
from ..fitting.fit import fit
from ..fitting.levels import fit_levels, level_counts
from ..gaussian.gaussians import Gaussians
from ..image.color import rgb_to_ycbcr
from ..image.metrics import psnr
from ..raster.render import picture_of
from .charts import new_figure
from .table import Table, number, save_csv
from .trial import whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Image = NDArray[np.float32]

BETWEEN = (1, 2)
"""Numbers of splats that are looked at, in each level, over those of the level before."""


class Point(NamedTuple):
    """PSNR in YCbCr of so many splats.

    Attributes
    ----------
    splats : int
    level : bool
        Whether a level ends there.
    levels : float
        The first of a set that was fitted in levels.
    alone : float
        A fit of so many.
    sorted : float
        Of a fit without levels, those that are worth most.
    """

    splats: int
    level: bool
    levels: float
    alone: float
    sorted: float


def measure(
    image: Image,
    gaussians: int,
    levels: int,
    iterations: int,
    seed: int = 0,
    backend: str | None = None,
    progress: Callable[[str, int, int], None] = lambda label, done, total: None,
) -> list[Point]:
    """Fit an image in levels, and by as many splats as are looked at.

    Parameters
    ----------
    image : ndarray of float32, shape (H, W, 3)
    gaussians, levels, iterations, seed, backend
        See `eigengs_dr.fit_levels`.
    progress : callable, optional
        ``progress(label, done, total)`` after every fit.
    """
    ends = level_counts(gaussians, levels)
    counts = sorted({factor * end for end in ends[:-1] for factor in BETWEEN} | {gaussians})
    settings: dict[str, Any] = {"iterations": iterations, "seed": seed, "backend": backend}

    def told(done: int) -> None:
        progress("fits", done, len(counts) + 1)

    told(0)
    nested = whole(fit_levels(image, gaussians, levels, **settings)).gaussians
    told(1)
    alone = {}
    for done, count in enumerate(counts, 2):
        alone[count] = whole(fit(image, count, **settings)).gaussians
        told(done)
    plain = alone[gaussians]
    best = plain[np.argsort(-removal_cost(plain, rgb_to_ycbcr(image)), kind="stable")]

    def reached(drawn: Gaussians) -> float:
        return psnr(picture_of(drawn), image, "ycbcr")

    return [
        Point(n, n in ends, reached(nested[:n]), reached(alone[n]), reached(best[:n]))
        for n in counts
    ]


def table(points: list[Point], name: str) -> Table:
    """Lay out the points of an image."""
    lines = [
        (
            f"{p.splats:,}" + (" *" if p.level else ""),
            *(number(value, 2) for value in (p.levels, p.alone, p.sorted)),
        )
        for p in points
    ]
    caption = (
        f"{name}: PSNR in YCbCr of so many splats (* a level ends): the first of a set in levels, "
        "a fit of so many, and those worth most of a fit without levels"
    )
    return Table(caption, ("splats", "levels", "fit of so many", "sorted fit"), lines)


def save_points(path: Path, points: list[Point]) -> None:
    """Write points as CSV; `OSError` if that fails."""
    save_csv(path, Point._fields, points)


def chart(points: list[Point], name: str) -> Figure:
    """Draw PSNR over splats.

    Raises
    ------
    ValueError
        If matplotlib is not installed.
    """
    figure = new_figure(6.4, 4.6)
    axis = figure.subplots()
    x = [p.splats for p in points]
    for field, label, style in (
        ("alone", "a fit of so many", "o--"),
        ("levels", "the first of one set, fitted in levels", "o-"),
        ("sorted", "those worth most of one set without levels", "s:"),
    ):
        axis.plot(x, [getattr(p, field) for p in points], style, ms=4, label=label)
    for p in points:
        if p.level:
            axis.axvline(p.splats, color="#888888", lw=0.6)
    axis.set_xscale("log", base=2)
    axis.xaxis.set_major_formatter("{x:,.0f}")
    axis.set(xlabel="Gaussians drawn", ylabel="PSNR in YCbCr / dB")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=9)
    figure.suptitle(f"Levels of detail: {name}; lines mark where levels end")
    return figure

"""Where another preset is ahead of "default": said plainly, from what was measured."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from eigengs_bench.harness.store import Row
from eigengs_bench.report.frames import MISSING, Table, frame_of, number, table
from eigengs_bench.report.sections.methods import groups_of, methods_of

Line = tuple[str, ...]


def where_default_loses(fits: Sequence[Row], cells: Sequence[Row]) -> Table:
    """List what "default" loses, by psnr_ycbcr.

    Parameters
    ----------
    fits : sequence of dict
        Of `eigengs_bench.experiments.tables.run`. Means over images are compared, of the methods of
        the main table with the same images: after as many steps, and after as many seconds
        (medians), when default has its best of all steps that it has taken by then. Before its
        first set is there, it has none.
    cells : sequence of dict
        Of `eigengs_bench.experiments.stability.run`: ends are compared.

    Returns
    -------
    Table
        No lines where default is ahead everywhere.
    """
    measured, cases = frame_of(fits, "moments"), frame_of(cells)
    lines = [line for key, some in groups_of(measured).items() for line in _of_set(*key, some)]
    lines += _of_cases(cases) if len(cases) else []
    columns = ("images or case", "when", "who is ahead", "its dB", "dB of default")
    caption = "Where another preset is ahead of default: PSNR YCbCr / dB"
    codes = [code for frame in (measured, cases) if len(frame) for code in frame.code]
    return table(caption, columns, lines, codes)


def _of_set(name: str, iterations: int, fits: pd.DataFrame) -> Iterator[Line]:
    fits = methods_of(fits, name, "main")
    default = fits[fits.method == "default"]
    ours = _course(default)
    first = ours.seconds.min() if len(ours) else 0.0
    for method, part in fits[fits.method != "default"].groupby("method", observed=True):
        if set(part.image) != set(default.image):
            continue
        course, said = _course(part), (f"{name}, {iterations:,} steps",)
        early = course.psnr[(course.seconds < first) & (course.psnr > -np.inf)]
        if len(early):
            yield *said, f"until {number(first, 3)} s", str(method), number(early.max()), MISSING
        for step, seconds, theirs in course.itertuples():
            if theirs > ours.psnr[step]:
                yield *said, f"{step:,} steps", str(method), number(theirs), _told(ours.psnr[step])
            reached = ours.psnr[ours.seconds <= seconds]
            if len(reached) and theirs > reached.max():
                when = f"{number(seconds, 3)} s"
                yield *said, when, str(method), number(theirs), _told(reached.max())


def _course(fits: pd.DataFrame) -> pd.DataFrame:
    """Median seconds and mean PSNR by steps. A fit that has failed is behind all others."""
    known = fits.assign(psnr_ycbcr=fits.psnr_ycbcr.fillna(-np.inf))
    return known.groupby("iteration").agg(
        seconds=("seconds", "median"), psnr=("psnr_ycbcr", "mean")
    )


def _told(decibels: float) -> str:
    return number(decibels) if decibels > -np.inf else "failed"


def _of_cases(cells: pd.DataFrame) -> Iterator[Line]:
    same = ["case", "iterations", "seed"]
    ours = cells[cells.preset == "default"].set_index(same).end_ycbcr.fillna(-np.inf)
    for cell in cells.itertuples():
        key = (cell.case, cell.iterations, cell.seed)
        if key in ours.index and cell.end_ycbcr > ours[key]:
            steps = f"{cell.iterations:,} steps"
            decibels = number(cell.end_ycbcr), _told(ours[key])
            yield f"case {cell.case}", steps, cell.preset, *decibels

"""Where another preset is ahead of "default"."""

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from eigengs_bench.harness.store import Row
from eigengs_bench.report.frames import MISSING, Section, frame_of, number, table
from eigengs_bench.report.sections.methods import groups_of, methods_of

Line = tuple[str, ...]


def where_default_loses(fits: Sequence[Row], cells: Sequence[Row]) -> Section:
    """List what "default" loses, by psnr_ycbcr, in rows of `tables` and of `stability`.

    Means over images are compared, of the methods of the main table with the same images: after as
    many steps, and after as many seconds (medians), when default has its best of all steps that it
    has taken by then. Before its first set is there, it has none. Of hard cases ends are compared.
    """
    measured, cases = frame_of(fits, "moments"), frame_of(cells)
    lines = [
        line
        for (name, steps), some in groups_of(measured).items()
        for line in _of_set(name, steps, some)
    ]
    lines += _of_cases(cases) if len(cases) else []
    columns = ("images or case", "when", "who is ahead", "its dB", "dB of default")
    caption = "Where another preset is ahead of default: PSNR YCbCr / dB"
    codes = [code for frame in (measured, cases) if len(frame) for code in frame.code]
    return Section([table(caption, columns, lines, codes)])


def _of_set(name: str, iterations: int, fits: pd.DataFrame) -> Iterator[Line]:
    fits, where = methods_of(fits, name, "main"), f"{name}, {iterations:,} steps"
    default = fits[fits.method == "default"]
    ours = _course(default)
    for method, part in fits[fits.method != "default"].groupby("method", sort=False):
        if set(part.image) != set(default.image):
            continue
        course, first = _course(part), ours.seconds.min()
        early = course.psnr[(course.seconds < first) & (course.psnr > -np.inf)]
        if len(early):
            yield where, f"until {number(first, 3)} s", method, number(early.max()), MISSING
        for step, seconds, theirs in course.itertuples():
            best = ours.psnr[ours.seconds <= seconds].max()  # NaN before the first
            for when, mine in ((f"{step:,} steps", ours.psnr[step]), (f"{seconds:.3f} s", best)):
                if theirs > mine:
                    yield where, when, method, number(theirs), _decibels(mine)


def _course(fits: pd.DataFrame) -> pd.DataFrame:
    """Median seconds and mean PSNR by steps. A fit that has failed is behind all others."""
    known = fits.assign(psnr=fits.psnr_ycbcr.fillna(-np.inf))
    return known.groupby("iteration").agg({"seconds": "median", "psnr": "mean"})


def _decibels(value: float) -> str:
    return number(value) if value > -np.inf else "failed"


def _of_cases(cells: pd.DataFrame) -> Iterator[Line]:
    same = ["case", "iterations", "seed"]
    cells = cells.reindex(columns=[*same, "preset", "end_ycbcr"])
    default = cells[cells.preset == "default"].assign(ours=lambda f: f.end_ycbcr.fillna(-np.inf))
    both = cells.merge(default[[*same, "ours"]], on=same)
    for cell in both[both.end_ycbcr > both.ours].itertuples():
        ends = number(cell.end_ycbcr), _decibels(cell.ours)
        yield f"case {cell.case}", f"{cell.iterations:,} steps", cell.preset, *ends

"""Where another preset is ahead of "default": said plainly, from what was measured."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from .rows import Row
from .sets import SETS
from .summary import by_method, by_set, label
from .table import MISSING, Table, number
from .tables import Method, methods

DEFAULT = Method("default")

Line = tuple[str, ...]


def table(fits: Sequence[Row], cells: Sequence[Row]) -> Table:
    """List what "default" loses, by psnr_ycbcr.

    Parameters
    ----------
    fits : sequence of dict
        Of `eigengs_dr.bench.tables.run`. Means over images are compared, of the methods of the main
        table with the same images: after as many steps, and after as many seconds (medians), when
        default has its best of all steps that it has taken by then. Before its first set is there,
        it has none.
    cells : sequence of dict
        Of `eigengs_dr.bench.stability.jobs`: ends are compared.

    Returns
    -------
    Table
        No rows where default is ahead everywhere.
    """
    lines = [line for key, rows in by_set(fits) for line in _of_set(*key, rows)]
    lines += _of_cases(cells)
    columns = ("images or case", "when", "who is ahead", "its dB", "dB of default")
    return Table("Where another preset is ahead of default: PSNR YCbCr / dB", columns, lines)


def _of_set(name: str, iterations: int, rows: Sequence[Row]) -> Iterator[Line]:
    fits = by_method(rows)
    images = {row["job"]["image"] for row in fits.get(DEFAULT, [])}
    ours = _course(fits.get(DEFAULT, []))
    first = min((seconds for seconds, _ in ours.values()), default=0.0)
    for method in (m for m in methods(name, "main", list(SETS)) if m in fits and m != DEFAULT):
        if {row["job"]["image"] for row in fits[method]} != images:
            continue
        course, said = _course(fits[method]), (f"{name}, {iterations:,} steps", label(method, name))
        early = [psnr for seconds, psnr in course.values() if seconds < first and psnr > -np.inf]
        if early:
            yield said[0], f"until {number(first, 3)} s", said[1], number(max(early)), MISSING
        for step, (seconds, theirs) in course.items():
            if theirs > ours[step][1]:
                yield said[0], f"{step:,} steps", said[1], number(theirs), _told(ours[step][1])
            reached = [psnr for taken, psnr in ours.values() if taken <= seconds]
            if reached and theirs > max(reached):
                best = _told(max(reached))
                yield said[0], f"{number(seconds, 3)} s", said[1], number(theirs), best


def _course(fits: Sequence[Row]) -> dict[int, tuple[float, float]]:
    """Median seconds and mean PSNR by steps."""
    steps: dict[int, list[Row]] = {}
    for row in fits:
        for moment in row["moments"]:
            steps.setdefault(moment["iteration"], []).append(moment)
    return {
        step: (
            float(np.median([m["seconds"] for m in moments])),
            float(np.mean([_known(m["psnr_ycbcr"]) for m in moments])),
        )
        for step, moments in steps.items()
    }


def _known(decibels: float | None) -> float:
    """A fit that has failed, null in the file, is behind all others."""
    return -np.inf if decibels is None else decibels


def _told(decibels: float) -> str:
    return number(decibels) if decibels > -np.inf else "failed"


def _of_cases(cells: Sequence[Row]) -> Iterator[Line]:
    ends = {
        (row["job"]["case"], row["job"]["iterations"], row["job"]["seed"]): _known(row["end_ycbcr"])
        for row in cells
        if row["job"]["preset"] == "default"
    }
    for row in cells:
        job = row["job"]
        ours = ends.get((job["case"], job["iterations"], job["seed"]))
        theirs = row.get("end_ycbcr")  # a preset that cannot run has none
        if ours is not None and theirs is not None and theirs > ours:
            steps = f"{job['iterations']:,} steps"
            yield f"case {job['case']}", steps, job["preset"], number(theirs), _told(ours)

"""Where another preset is ahead of "default": said plainly, from what was measured."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from .rows import Row
from .summary import by_method, by_set, label
from .table import MISSING, Table, number
from .tables import Method

DEFAULT = Method("default")

Line = tuple[str, ...]


def table(fits: Sequence[Row], cells: Sequence[Row]) -> Table:
    """List what "default" loses, by psnr_ycbcr.

    Parameters
    ----------
    fits : sequence of dict
        Of `eigengs_dr.bench.tables.run`. Means over images are compared, of a method with the same
        images: after as many steps, and after as many seconds (medians), when default has its best
        of all steps that it has taken by then.
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
    methods = by_method(rows)
    images = {row["job"]["image"] for row in methods.get(DEFAULT, [])}
    ours = _course(methods.get(DEFAULT, []))
    for method, fits in methods.items():
        if method.preset == "default" or {row["job"]["image"] for row in fits} != images:
            continue
        where, who = f"{name}, {iterations:,} steps in all", label(method, name)
        for step, (seconds, theirs) in _course(fits).items():
            if theirs > ours[step][1]:
                yield where, f"{step:,} steps", who, number(theirs), number(ours[step][1])
            reached = [psnr for taken, psnr in ours.values() if taken <= seconds]
            if theirs > max(reached, default=-np.inf):
                best = number(max(reached)) if reached else f"{MISSING} (has not started)"
                yield where, f"{number(seconds, 3)} s", who, number(theirs), best


def _course(fits: Sequence[Row]) -> dict[int, tuple[float, float]]:
    """Median seconds and mean PSNR by steps."""
    steps: dict[int, list[Row]] = {}
    for row in fits:
        for moment in row["moments"]:
            steps.setdefault(moment["iteration"], []).append(moment)
    return {
        step: (
            float(np.median([m["seconds"] for m in moments])),
            # The PSNR of equal images is null in the file.
            float(np.mean([np.inf if (p := m["psnr_ycbcr"]) is None else p for m in moments])),
        )
        for step, moments in steps.items()
    }


def _of_cases(cells: Sequence[Row]) -> Iterator[Line]:
    ends = {
        (row["job"]["case"], row["job"]["iterations"], row["job"]["seed"]): row["end_ycbcr"]
        for row in cells
        if row["job"]["preset"] == "default"
    }
    for row in cells:
        job = row["job"]
        ours = ends.get((job["case"], job["iterations"], job["seed"]))
        theirs = row.get("end_ycbcr")  # a preset that cannot run has none
        if ours is not None and theirs is not None and theirs > ours:
            steps = f"{job['iterations']:,} steps"
            yield f"case {job['case']}", steps, job["preset"], number(theirs), number(ours)

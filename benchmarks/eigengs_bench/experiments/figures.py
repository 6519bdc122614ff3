"""The pictures of the paper: which there are, what they need, and the list of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from eigengs_bench.experiments.figure_charts import PANELS, curves, radii
from eigengs_bench.experiments.figure_strips import (
    CATS,
    Figure,
    colors,
    cross,
    iterations,
    present,
    split,
)
from eigengs_bench.harness.store import Row, today
from eigengs_bench.harness.task import Task
from eigengs_bench.names import FIGURES, NATURAL
from eigengs_dr.report import write_report

LIST = "figures.json"

USED: dict[str, tuple[Sequence[str], int]] = {
    "iterations": (("kodak", CATS), 0),
    "colors": ((), 0),
    "curves": (tuple(PANELS), 1),
    "radii": ((CATS,), 1),
    "split": ((CATS,), 1),
    "cross": ((CATS, NATURAL), 2),
}
"""Sets that a figure shows, and how many of them it cannot do without."""


def run(
    task: Task, names: Collection[str] = (), note: Callable[[str], None] = lambda text: None
) -> list[Figure]:
    """Draw figures into a folder, and list them in its ``figures.json``.

    Models are kept in ``models/``, measurements in ``curves.jsonl``: a second run goes on with
    both.

    Parameters
    ----------
    task : Task
    names : collection of str, optional
        Of `FIGURES`; all by default.
    note : callable, optional
        Told in one line which sets were left out because they are not there.

    Returns
    -------
    list of Figure
        In the order of `FIGURES`.

    Raises
    ------
    ValueError
        If nothing can be drawn.
    OSError
        If the folder cannot be written.
    """
    wanted = [name for name in FIGURES if not names or name in names]
    lacking = {name: [s for s in USED[name][0] if not present(task, s)] for name in wanted}
    if any(lacking.values()):
        parts = [f"{name} ({', '.join(missing)})" for name, missing in lacking.items() if missing]
        why = f"no such sets in {task.data}" if task.data else "no folder DATA was named"
        note(f"left out: {'; '.join(parts)}: {why}")
    drawn = [name for name in wanted if len(USED[name][0]) - len(lacking[name]) >= USED[name][1]]
    if not drawn:
        raise ValueError("no figure can be drawn without these sets; --figure colors needs none")
    listed = read_list(task.folder / LIST)  # a damaged list is told now, not after minutes
    studies = (iterations, colors, curves, radii, split, cross)
    by_name = dict(zip(FIGURES, studies, strict=True))
    made = [figure for name in drawn for figure in by_name[name](task)]
    fresh = [{**figure._asdict(), "run": {"date": today(), **task.about}} for figure in made]
    kept = [entry for entry in listed if entry["name"] not in drawn]
    entries = sorted(kept + fresh, key=lambda entry: FIGURES.index(entry["name"]))
    write_report(task.folder / LIST, {"figures": entries})
    return made


def read_list(path: Path) -> list[Row]:
    """Read the figures that runs have listed, each with its "run"; none where there is no list.

    Raises
    ------
    ValueError
        If the file is damaged.
    """
    if not path.exists():
        return []
    try:
        found = json.loads(path.read_text(encoding="utf-8"))["figures"]
        return [{key: figure[key] for key in (*Figure._fields, "run")} for figure in found]
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{path}: is damaged; delete it, and draw the figures again") from None

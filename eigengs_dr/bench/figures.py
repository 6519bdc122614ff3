"""The pictures of the paper, from code: which there are, and what they need."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path

from ..cli.report import write_report
from ..storage.atomic import require_writable
from . import charts, figure_charts, figure_strips, rows, sets
from .figure_charts import PANELS
from .figure_task import CATS, NATURAL, Figure, Progress, Task

STUDIES: dict[str, Callable[[Task], Iterator[Figure]]] = {
    "iterations": figure_strips.iterations,
    "colors": figure_strips.colors,
    "curves": figure_charts.curves,
    "radii": figure_charts.radii,
    "split": figure_strips.split,
    "cross": figure_strips.cross,
}
"""The figures by name, in their order."""

USED: dict[str, Sequence[str]] = {
    "iterations": ("kodak", CATS),
    "colors": (),
    "curves": tuple(PANELS),
    "radii": (CATS,),
    "split": (CATS,),
    "cross": (CATS, NATURAL),
}
"""Sets that a figure shows."""

NEEDED = {"iterations": 0, "colors": 0, "curves": 1, "radii": 1, "split": 1, "cross": 2}
"""So many of them it cannot do without."""


def run(
    folder: Path,
    data: Path | None,
    machine: rows.Row,
    names: Collection[str] = (),
    iterations: int = 1000,
    images: int = 8,
    seed: int = 0,
    backend: str | None = None,
    progress: Progress = lambda label, done, total: None,
    note: Callable[[str], None] = lambda text: None,
) -> list[Figure]:
    """Draw figures into a folder, and add them to the list in its ``figures.json``.

    Models are kept in ``models/``, measurements in ``curves.jsonl``: a second run goes on with
    both.

    Parameters
    ----------
    folder : Path
        Made where it is missing.
    data : Path or None
        Folder of the sets; without it only what needs none is drawn.
    machine : dict
        "command", and what tells machines apart; see `rows.measure`.
    names : collection of str, optional
        Keys of `STUDIES`; all by default.
    iterations : int, optional
        Steps of every descent.
    images : int, optional
        Test images a set, for what is a mean over them.
    seed : int, optional
    backend : {"llvm", "cuda"}, optional
    progress : callable, optional
        ``progress(label, done, total)``.
    note : callable, optional
        Told what was left out for want of images, in one line.

    Returns
    -------
    list of Figure
        In the order of `STUDIES`.

    Raises
    ------
    ValueError
        If a name is unknown, nothing can be drawn, or matplotlib is missing and needed.
    OSError
        If the folder cannot be written.
    """
    unknown = [name for name in names if name not in STUDIES]
    if unknown:
        raise ValueError(f"figure {unknown[0]!r} is unknown; use one of {', '.join(STUDIES)}")
    wanted = [name for name in STUDIES if not names or name in names]
    present = _present(data) if data else ()
    lacking = {name: [s for s in USED[name] if s not in present] for name in wanted}
    drawn = [name for name in wanted if len(USED[name]) - len(lacking[name]) >= NEEDED[name]]
    if any(lacking.values()):
        note(_left_out(lacking, data))
    if not drawn:
        raise ValueError("no figure can be drawn without these sets; --figure colors needs none")
    if {"curves", "radii"} & set(drawn):
        charts.new_figure(1, 1)  # asked for now, not after minutes
    folder.mkdir(parents=True, exist_ok=True)
    require_writable(folder / "figures.json")
    read_list(folder / "figures.json")  # if it is damaged, not told after minutes
    task = Task(
        folder, data or Path(), present, machine, iterations, images, seed, backend, progress
    )
    made = [figure for name in drawn for figure in STUDIES[name](task)]
    _list(folder / "figures.json", made, {"date": rows.today(), **machine})
    return made


def read_list(path: Path) -> list[rows.Row]:
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


def _list(path: Path, made: Sequence[Figure], run: rows.Row) -> None:
    """List figures, with those of earlier runs that show something else."""
    names = {figure.name for figure in made}
    listed = [figure for figure in read_list(path) if figure["name"] not in names]
    listed += [{**figure._asdict(), "run": run} for figure in made]
    listed.sort(key=lambda figure: list(STUDIES).index(figure["name"]))
    write_report(path, {"figures": listed})


def _present(data: Path) -> tuple[str, ...]:
    """Sets of a folder of data, with images to train on where models are trained on them."""
    found = []
    for name, chosen in sets.SETS.items():
        folder = data / chosen.folder
        parts = [folder] if name == "kodak" else [folder / "train", folder / "test"]
        if all(part.is_dir() for part in parts):
            found.append(name)
    return tuple(found)


def _left_out(lacking: dict[str, list[str]], data: Path | None) -> str:
    """What is missing in the figures, and why."""
    parts = [f"{name} ({', '.join(missing)})" for name, missing in lacking.items() if missing]
    why = f"no such sets in {data}" if data else "no folder DATA of image sets was named"
    return f"left out: {'; '.join(parts)}: {why}"

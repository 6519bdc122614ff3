"""Measurements as lines of JSON, added one by one: a run that was broken off goes on later."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from ..cli.report import plain
from ..storage.atomic import atomic_write

Row = dict[str, Any]

Job = tuple[Row, Callable[[], Row]]
"""What names a measurement (the seed is part of it), and the function that makes it."""

Progress = Callable[[int, int], None]


def measure(
    path: Path,
    jobs: Iterable[Job],
    run: Row,
    progress: Progress = lambda done, total: None,
) -> list[Row]:
    """Do those jobs that a file does not hold yet, adding a line after each.

    A line has the job's name under "job", what its function returned, and "run": the date, and all
    of `run`.

    Parameters
    ----------
    path : Path
        Made where it is missing.
    jobs : iterable of Job
        In the order in which they are measured.
    run : dict
        "command", and beside it what tells machines and versions apart. Nothing else tells rows of
        another method from those of the present one: where a method changes, so must the version.
    progress : callable, optional
        ``progress(done, total)`` before every job and after the last.

    Returns
    -------
    list of dict
        The rows of these jobs in their order, old ones and new ones.

    Raises
    ------
    ValueError
        If the file is damaged, or was written on another machine or with other versions: their
        seconds must not meet in one table.
    OSError
        If it cannot be written.
    """
    known = {_key(row["job"]): row for row in read(path)}
    for row in known.values():
        if _machine(row["run"]) != _machine(run):
            raise ValueError(
                f"{path}: was measured on another machine or with other versions "
                f"({row['run'].get('cpu')}); write to another folder, or delete the file"
            )
    wanted, rows = list(jobs), []
    for done, (name, work) in enumerate(wanted):
        progress(done, len(wanted))
        key = _key(name)
        if key not in known:
            known[key] = plain({"job": name, **work(), "run": {"date": today(), **run}})
            _append(path, known[key])
        rows.append(known[key])
    progress(len(wanted), len(wanted))
    return rows


def read(path: Path) -> list[Row]:
    """Read the rows of a file, none where there is none; a last line that was cut short is dropped.

    Raises
    ------
    ValueError
        If another line is not a row of `measure`.
    """
    return list(_rows(path)) if path.exists() else []


def today() -> str:
    """Date and time, as rows and reports tell it."""
    return datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")


def _rows(path: Path) -> Iterator[Row]:
    lines = path.read_text(encoding="utf-8").split("\n")
    for number, line in enumerate(lines[:-1], 1):  # what follows the last line break is not whole
        try:
            row = json.loads(line)
            if not isinstance(row["job"], dict) or not isinstance(row["run"], dict):
                raise TypeError
        except (ValueError, KeyError, TypeError):
            raise ValueError(
                f"{path}: line {number} is not a measurement; delete that line"
            ) from None
        yield row


def _append(path: Path, row: Row) -> None:
    """Add a line behind the last whole one."""
    if not path.exists():
        with atomic_write(path):
            pass
    with path.open("rb+") as file:
        whole = file.read().rfind(b"\n") + 1
        file.seek(whole)
        file.truncate()
        file.write((json.dumps(row, allow_nan=False) + "\n").encode())
        file.flush()
        os.fsync(file.fileno())


def _key(name: Row) -> str:
    return json.dumps(plain(name), sort_keys=True)


def _machine(run: Row) -> Row:
    return {key: value for key, value in run.items() if key not in ("command", "date")}

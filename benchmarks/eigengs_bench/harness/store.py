"""Measurements as lines of JSON, one by one: a run continues after a break.

A row has "job", its name; its figures; and "run": the date, the command, the machine, the versions,
and the "commit" of the code with "clean", whether no tracked file differed from it. The seconds of
other machines or versions differ: their rows are an error. Rows of other code are used, with a note
when a file is continued, and in the caption of every table.
"""

import json
import os
import subprocess
from collections import Counter
from collections.abc import Callable, Iterable
from datetime import datetime, timezone
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from eigengs_dr.cli.outputs import plain

Row = dict[str, Any]
Job = tuple[Row, Callable[[], Row]]  # what names a measurement, its seed too, and what makes it
Progress = Callable[..., None]  # progress(label, done, total), see eigengs_dr.cli.console

NOT_MACHINE = ("command", "date", "commit", "clean")


class Task(NamedTuple):
    """What experiments share: `folder` of rows and models, `data` of image sets, `run` of rows."""

    folder: Path
    run: Row
    data: Path | None = None
    images: int = 20
    iterations: int = 1000
    seed: int = 0
    backend: str | None = None
    progress: Progress = lambda *_: None

    def measure(self, file: str, jobs: Iterable[Job], label: str) -> list[Row]:
        """Continue a file of the folder; see the function `measure`."""
        return measure(self.folder / file, jobs, self.run, partial(self.progress, label))


def measure(
    path: Path, jobs: Iterable[Job], run: Row, progress: Progress = lambda *_: None
) -> list[Row]:
    """Do the jobs that a file does not hold yet, and add a line after each; return their rows.

    `ValueError` if the file is damaged, or of another machine or other versions.
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
    """Read the rows of a file, none where there is none; `ValueError` names a damaged line.

    An incomplete last line does not count.
    """
    found = []
    lines = path.read_text("utf-8", "replace").split("\n")[:-1] if path.exists() else []
    for number, line in enumerate(lines, 1):
        try:
            found.append(json.loads(line))
            if not isinstance(found[-1]["job"], dict) or not isinstance(found[-1]["run"], dict):
                raise TypeError
        except (ValueError, KeyError, TypeError):
            message = f"{path}: line {number} is not a measurement; delete that line"
            raise ValueError(message) from None
    return found


def today() -> str:
    """Return the date and time for a row."""
    return datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")


def code_state() -> Row:
    """Find the commit of the code, and whether its tree is clean; both are None without git."""
    spec = find_spec("eigengs_dr")
    folder = Path(str(spec and spec.origin)).parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", "__init__.py")  # not a package below another tree
        clean = not git("status", "--porcelain", "--untracked-files=no")
        return {"commit": git("rev-parse", "HEAD"), "clean": clean}
    except (OSError, subprocess.CalledProcessError):
        return {"commit": None, "clean": None}


def code_name(run: Row) -> str:
    """Name the code of a run: "commit 0a1b2c3d4", and whether its tree was not clean."""
    if not run.get("commit"):
        return f"version {run.get('versions', {}).get('eigengs_dr', 'unknown')}, commit unknown"
    return f"commit {run['commit'][:9]}" + ("" if run["clean"] else " with uncommitted changes")


def count_codes(runs: Iterable[Row]) -> str:
    """Count the rows of each code: "commit 0a1b2c3d4 (12), ..."."""
    return ", ".join(f"{name} ({n})" for name, n in Counter(map(code_name, runs)).most_common())


def other_code(path: Path, run: Row) -> str:
    """Say in one line which rows of a file are of other code than a run; "" for none."""
    others = [row["run"] for row in read(path) if code_name(row["run"]) != code_name(run)]
    text = (
        f"{path}: rows of other code are used as they are: {count_codes(others)}; now it is "
        f"{code_name(run)}. To measure all of them again, write to another folder"
    )
    return text if others else ""


def _append(path: Path, row: Row) -> None:
    """Add a line behind the last whole one."""
    path.touch()
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
    return {key: value for key, value in run.items() if key not in NOT_MACHINE}

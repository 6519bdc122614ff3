"""Measurements as lines of JSON, written one by one: an interrupted run resumes.

A row has "bench", the question; "job", the name of the measurement; its figures; and "run": date,
command, machine, versions, and the "commit" of the code with "clean", whether no tracked file
outside docs/ differed from it. Seconds depend on machine and versions: a folder holds rows of one
machine.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from datetime import datetime, timezone
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import eigengs_dr
from eigengs_dr.cli.outputs import plain
from eigengs_dr.storage.atomic import atomic_write

Row = dict[str, Any]
Job = tuple[Row, Callable[[], Row]]  # what names a measurement, and what makes it

FILE = "rows.jsonl"
NOT_MACHINE = ("command", "date", "commit", "clean")
RECORDED = ("command", "date", "commit", "clean", "cpu", "threads", "backend")
STATUS = Path("/proc/self/status")  # of Linux


class Task(NamedTuple):
    """What questions share: the `folder` of rows and models, the `data`, and the `run` of rows."""

    folder: Path
    run: Row
    data: Path | None = None
    images: int = 20
    iterations: int = 1000
    backend: str | None = None
    progress: Callable[..., None] = lambda *_: None  # progress(label, done, total)

    def measure(self, bench: str, jobs: Iterable[Job], label: str = "") -> list[Row]:
        """Do the jobs that the folder has no rows for, add a row after each, and return all rows.

        `ValueError` if the file of rows is damaged, or comes from another machine or version.
        """
        path = self.folder / FILE
        measured = {_key(row["bench"], row["job"]): row for row in read(path)}
        for row in measured.values():
            if _machine(row["run"]) != _machine(self.run):
                raise ValueError(
                    f"{path}: was measured on another machine or with other versions "
                    f"({row['run'].get('cpu')}); write to another folder, or delete the file"
                )
        named, rows = list(jobs), []
        for done, (name, work) in enumerate(named):
            self.progress(label or bench, done, len(named))
            key = _key(bench, name)
            if key not in measured:
                now = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
                row = {"bench": bench, "job": name, **work(), "run": {"date": now, **self.run}}
                measured[key] = plain(row)
                _append(path, measured[key])
            rows.append(measured[key])
        self.progress(label or bench, len(named), len(named))
        return rows


def read(path: Path, bench: str = "") -> list[Row]:
    """Read the rows of a file, for one question or all; `ValueError` names a damaged line.

    An incomplete last line does not count.
    """
    rows = []
    lines = path.read_text("utf-8", "replace").split("\n")[:-1] if path.exists() else []
    for number, line in enumerate(lines, 1):
        try:
            row = json.loads(line)
            if not isinstance(row["job"], dict) or not isinstance(row["run"], dict):
                raise TypeError
            if bench in ("", row["bench"]):
                rows.append(row)
        except (ValueError, KeyError, TypeError):
            message = f"{path}: line {number} is not a measurement; delete that line"
            raise ValueError(message) from None
    return rows


def record(path: Path, rows: Iterable[Row]) -> None:
    """Add rows with 5 digits to a file for the manual; they replace rows of the same name.

    A measurement that is repeated each time, "at" some second, has one row there.
    """
    kept_rows = {_key(row["bench"], row["job"]): row for row in read(path)}
    for row in rows:
        job = {k: v for k, v in row["job"].items() if k != "at"}
        kept = {k: v for k, v in row["run"]["versions"].items() if v and not k.endswith("_path")}
        run = {k: row["run"][k] for k in RECORDED} | {"versions": kept}
        text = json.dumps(row | {"run": run})
        rounded = json.loads(text, parse_float=lambda number: float(f"{float(number):.5g}"))
        kept_rows[_key(row["bench"], job)] = rounded | {"job": job}
    lines = map(json.dumps, kept_rows.values())
    with atomic_write(path) as temporary:
        temporary.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def code_state(folder: Path = Path(eigengs_dr.__file__).parent) -> Row:
    """Find the commit of the code, and whether all but docs/ is clean; None without git."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", "__init__.py")  # not a package inside another tree
        everything = ("--", ":/", ":(top,exclude)docs")  # the rows of the manual are there
        clean = not git("status", "--porcelain", "--untracked-files=no", *everything)
        return {"commit": git("rev-parse", "HEAD"), "clean": clean}
    except (OSError, subprocess.CalledProcessError):
        return {"commit": None, "clean": None}


def code_name(run: Row) -> str:
    """Name the code of a run: "commit 0a1b2c3d4", and whether it had uncommitted changes."""
    if not run.get("commit"):
        return f"version {run.get('versions', {}).get('eigengs_dr', 'unknown')}, commit unknown"
    return f"commit {run['commit'][:9]}" + ("" if run["clean"] else " with uncommitted changes")


def alone(title: str, work: Callable[..., Row], *arguments: Any) -> Callable[[], Row]:
    """Return a function that measures in a new process, so that its peak memory is its own.

    It raises `ValueError` with the title if memory runs out.
    """

    def measure() -> Row:
        try:
            with ProcessPoolExecutor(1, get_context("spawn")) as pool:
                return pool.submit(work, *arguments).result()
        except BrokenProcessPool:
            raise ValueError(
                f"{title}: its process was killed, perhaps because memory ran out; "
                "free some, or leave the case out"
            ) from None

    return measure


def peak_gib() -> float | None:
    """Return the peak memory of this process so far, in GiB; None on Windows."""
    if sys.platform == "win32":
        return None
    if STATUS.exists():  # the figure of getrusage includes the process that started this one
        lines = (line.split() for line in STATUS.read_text().splitlines())
        return next(int(line[1]) / (1 << 20) for line in lines if line[0] == "VmHWM:")
    import resource

    unit = 30 if sys.platform == "darwin" else 20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << unit)


def _append(path: Path, row: Row) -> None:
    """Append a row after the last complete line."""
    path.touch()
    with path.open("rb+") as file:
        whole = file.read().rfind(b"\n") + 1
        file.seek(whole)
        file.truncate()
        file.write((json.dumps(row, allow_nan=False) + "\n").encode())
        file.flush()
        os.fsync(file.fileno())


def _key(bench: str, name: Row) -> str:
    return json.dumps([bench, plain(name)], sort_keys=True)


def _machine(run: Row) -> Row:
    return {key: value for key, value in run.items() if key not in NOT_MACHINE}

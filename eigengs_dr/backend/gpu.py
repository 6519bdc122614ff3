"""Whether a GPU computes what llvm computes: trials in other processes, one verdict a machine.

A trial is a small piece of work, ``eigengs-dr doctor --trial NAME``, which prints its figures. It
runs in another process for each backend, so that a driver that crashes ends only that process.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from .types import Record

ALLOWED = {"fit": 0.05, "gradients": 1e-3, "texture": 1e-3, "scene": 5e-3}
"""Largest difference of the figures of a trial, by its name: decibels for "fit", else a share of
the largest figure. On a GPU sums run in another order, and some instructions have 20 bits."""

TRIAL_SECONDS = 600.0
"""Time for a trial, most of which compiles its programs."""


class Trial(NamedTuple):
    """A trial on one backend.

    Attributes
    ----------
    seconds : float
        Of a second run in the process, whose programs are compiled.
    figures : list of float
    problem : str
        One line, if the trial has failed; else empty.
    """

    seconds: float
    figures: list[float]
    problem: str = ""


class Comparison(NamedTuple):
    """A trial on llvm and on a GPU.

    Attributes
    ----------
    name : str
        A key of `ALLOWED`.
    llvm, gpu : Trial
    difference : float
        See `ALLOWED`; infinite if one of the two has failed.
    """

    name: str
    llvm: Trial
    gpu: Trial
    difference: float

    @property
    def agrees(self) -> bool:
        """Whether the difference is allowed."""
        return self.difference <= ALLOWED[self.name]


def compare(name: str, backend: str) -> Comparison:
    """Run a trial on llvm and on a GPU, in some seconds to a minute.

    Parameters
    ----------
    name : str
        A key of `ALLOWED`.
    backend : {"cuda", "metal"}
    """
    llvm, gpu = run_trial(name, "llvm"), run_trial(name, backend)
    difference = float("inf")
    if not (llvm.problem or gpu.problem) and len(llvm.figures) == len(gpu.figures):
        unit = 1.0 if name == "fit" else max(map(abs, llvm.figures))
        pairs = zip(llvm.figures, gpu.figures, strict=True)
        differences = [abs(one - other) / unit for one, other in pairs]
        if all(map(math.isfinite, differences)):
            difference = max(differences)
    return Comparison(name, llvm, gpu, difference)


def run_trial(name: str, backend: str) -> Trial:
    """Run one trial on one backend, in another process."""
    command = [sys.executable, "-m", "eigengs_dr", "doctor", "--trial", name, "--backend", backend]
    try:
        process = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=TRIAL_SECONDS
        )
    except subprocess.TimeoutExpired:
        return Trial(0.0, [], f"no end after {TRIAL_SECONDS:.0f} s")
    if process.returncode == 0:
        answer: Record = json.loads(process.stdout.splitlines()[-1])
        return Trial(answer["seconds"], answer["figures"])
    lines = process.stderr.splitlines()
    return Trial(0.0, [], f"exit code {process.returncode}: {lines[-1] if lines else ''}"[:200])


def agrees(backend: str, identity: str) -> bool:
    """Whether a fit on a GPU agrees with one on llvm, as a trial has shown once on this machine.

    The verdict is kept in `verdict_file`. Where no trial can run, because llvm does not work, the
    GPU has nothing to be compared with, and counts as right.

    Parameters
    ----------
    backend : {"cuda", "metal"}
    identity : str
        What the verdict holds for: the device and the versions. Another one is tried anew.
    """
    path = verdict_file()
    verdicts: dict[str, bool] = {}
    with suppress(OSError, ValueError):
        content = json.loads(path.read_text(encoding="utf-8"))
        verdicts = {str(key): bool(value) for key, value in content.items()}
    if identity not in verdicts:
        comparison = compare("fit", backend)
        if comparison.llvm.problem:
            return True
        verdicts[identity] = comparison.agrees
        with suppress(OSError):  # a home that is read-only: the next process tries again
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(verdicts), encoding="utf-8")  # half a file is tried anew
    return verdicts[identity]


def verdict_file() -> Path:
    """Return the file of the verdicts, in the folder of Dr.Jit's compiled programs."""
    folder = os.environ.get("DRJIT_CACHE_DIR")
    return (Path(folder) if folder else Path.home() / ".drjit") / "eigengs-dr-gpu.json"

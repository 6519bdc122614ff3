"""Check that a GPU computes the same as llvm: trials in other processes.

A trial, ``eigengs-dr doctor --trial NAME``, is a small computation that prints its figures. Each
backend runs it in a process of its own, so that a driver that crashes ends only that process.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from typing import NamedTuple

from .types import Record

ALLOWED = {"fit": 0.05, "gradients": 1e-3, "texture": 1e-3, "scene": 5e-3}
"""Largest allowed difference of the figures of each trial: in dB for "fit", otherwise relative to
the largest figure. A GPU sums in another order, and some of its instructions have 20 bits."""

TRIAL_SECONDS = 600.0
"""Time limit of a trial, which spends most of it compiling its programs."""


class Trial(NamedTuple):
    """A trial on one backend.

    Attributes
    ----------
    seconds : float
        Time of the second run in the process, after its programs are compiled.
    figures : list of float
    problem : str
        One line if the trial has failed, otherwise empty.
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
    """Run a trial on llvm and on a GPU; this takes between a few seconds and a minute.

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
        return Trial(0.0, [], f"not finished after {TRIAL_SECONDS:.0f} s")
    if process.returncode == 0:
        answer: Record = json.loads(process.stdout.splitlines()[-1])
        return Trial(answer["seconds"], answer["figures"])
    lines = process.stderr.splitlines()
    return Trial(0.0, [], f"exit code {process.returncode}: {lines[-1] if lines else ''}"[:200])

"""What an experiment is told: where its images are, where its rows go, and how long it may take."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from eigengs_bench.harness.store import Job, Row, measure

Progress = Callable[..., None]
"""``progress(label, done, total)``, with a row of figures as a fourth argument where there is one;
see `eigengs_dr.console.progress_bar`."""


def no_progress(label: str, done: int, total: int, row: Row | None = None) -> None:
    """Show nothing."""


class Task(NamedTuple):
    """Settings that experiments share.

    Attributes
    ----------
    folder : Path
        Where rows are continued and models are kept.
    data : Path or None
        The folder of image sets.
    about : dict
        What rows say of their run, see `measure`.
    images : int
        How many of a set, at most.
    iterations : int
        Steps of every fit.
    seed : int
    backend : {"llvm", "cuda"} or None
    progress : Progress
    """

    folder: Path
    data: Path | None
    about: Row
    images: int = 20
    iterations: int = 1000
    seed: int = 0
    backend: str | None = None
    progress: Progress = no_progress

    def measure(self, file: str, jobs: Iterable[Job], label: str) -> list[Row]:
        """Continue a file of the folder, see `eigengs_bench.harness.store.measure`."""
        return measure(self.folder / file, jobs, self.about, partial(self.progress, label))

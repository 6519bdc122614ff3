"""What the tests of the benchmarks share: rows, sets of tiny images, and the command."""

from pathlib import Path

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import family

pytest.importorskip("eigengs_bench", reason="pip install ./benchmarks")

from eigengs_bench.names import SETS, ImageSet
from eigengs_bench.rows import Task

RUN = {
    "command": "eigengs-dr bench tables",
    "date": "2026-01-01 10:00 UTC",
    "cpu": "a CPU",
    "threads": 2,
    "backend": "llvm",
    "versions": {"eigengs_dr": "0.1.0", "libllvm_path": "/usr/lib/x.so"},
    "commit": "a" * 40,
    "clean": True,
}


def task_in(folder, backend=None, data=None, **settings):
    """A task whose rows are of `RUN`."""
    return Task(Path(folder), RUN, data, backend=backend, **settings)


@pytest.fixture
def data(tmp_path, monkeypatch):
    """Sets of 32x32 pixels, 2 images to measure on and 14 to train on."""
    folder = tmp_path / "data"
    for seed, name in enumerate(("cats256", "natural256")):
        for k, image in enumerate(family(16, seed=seed)):
            path = folder / name / ("test" if k < 2 else "train")
            path.mkdir(parents=True, exist_ok=True)
            eg.save_image(path / f"{k:02}.png", image)
        monkeypatch.setitem(SETS, name, ImageSet(name, 32, 32, 60))
    return folder


def row(job, run=RUN, **figures):
    """A row of any question."""
    return {"bench": "made", "job": job, **figures, "run": run}


def lines_of(table):
    """The lines of a table, as tuples of texts."""
    return [tuple(line) for line in table.frame.to_numpy()]


def one_image(seed=5):
    """An image of 32x32 pixels."""
    return np.asarray(family(1, side=32, seed=seed)[0])


def smaller(monkeypatch, *modules, **values):
    """Give the numbers of a benchmark, which are those of a measurement, the size of a test."""
    for module in modules:
        for name in vars(module).keys() & values.keys():
            monkeypatch.setattr(module, name, values[name])

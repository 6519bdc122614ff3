"""What the tests of the benchmarks share: rows, sets of tiny images, and the command."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from _helpers.families import family, small_model  # noqa: F401  for the tests, from one place

pytest.importorskip("eigengs_bench", reason="pip install ./benchmarks")

from eigengs_bench.harness.store import Task
from eigengs_bench.names import SETS, ImageSet
from eigengs_dr.cli.main import main
from eigengs_dr.fitting.fit import FitInterrupted
from eigengs_dr.image.io import save_image

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


def run(*arguments):
    """Call the program with its arguments."""
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def task_in(folder, backend=None, data=None, **settings):
    """A task whose rows are of `RUN`."""
    return Task(Path(folder), RUN, data, backend=backend, **settings)


def make_sets(folder, monkeypatch, names=("faces256", "natural256"), gaussians=60):
    """Write sets of 32x32 pixels, 2 images to measure on and 14 to train on, and shrink `SETS`."""
    for seed, name in enumerate(names):
        for k, image in enumerate(family(16, seed=seed)):
            path = folder / name / ("test" if k < 2 else "train")
            path.mkdir(parents=True, exist_ok=True)
            save_image(path / f"{k:02}.png", image)
        monkeypatch.setitem(SETS, name, ImageSet(name, 32, 32, gaussians))
    monkeypatch.setattr("eigengs_bench.harness.datasets.MAX_COMPONENTS", 8)
    return folder


def moment(iteration, decibels, seconds=1.0):
    """A row of `score`; None for a fit that has failed."""
    rgb = None if decibels is None else decibels - 6
    figures = {"psnr_ycbcr": decibels, "psnr_rgb": rgb, "ssim": 0.5, "ms_ssim": 0.75}
    return {"iteration": iteration, "seconds": seconds, **figures}


def fit_row(image, moments, preset="default", run=RUN, iterations=1000, **method):
    """A row of `tables` on the set faces256."""
    job = {"set": "faces256", "image": image, "iterations": iterations, "seed": 0, "gaussians": 60}
    usual = {"preset": preset, "source": "", "components": 0, "space": "ycbcr", "split": "auto"}
    return {"job": {**job, **usual, **method}, "moments": moments, "run": run}


def cell_row(case, preset="default", run=RUN, **figures):
    """A row of `stability`."""
    job = {"case": case, "preset": preset, "seed": 0, "iterations": 100}
    usual = {} if "needs" in figures else {"finite": True, "start_ycbcr": 30.0, "end_ycbcr": 40.0}
    return {"job": job, **usual, **figures, "run": run}


def lines_of(table):
    """The lines of a table, as tuples of texts."""
    return [tuple(line) for line in table.frame.to_numpy()]


def one_image(seed=5):
    """An image of 32x32 pixels."""
    return np.asarray(family(1, side=32, seed=seed)[0])


def broken_off(*arguments, **settings):
    """Stand for a fit in which Ctrl-C is pressed."""
    raise FitInterrupted(None)

"""The paper's figures that are charts: PSNR over iterations, and how large splats are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from eigengs_bench.experiments.figure_strips import (
    CATS,
    COMPONENTS,
    METHODS,
    Figure,
    descent,
    present,
    to_size,
)
from eigengs_bench.harness.datasets import images_of, model_for
from eigengs_bench.harness.store import Row
from eigengs_bench.harness.task import Task
from eigengs_bench.harness.timing import Image
from eigengs_bench.report.charts import Curve, Radii, curves_chart, radii_chart, save_figure
from eigengs_bench.report.frames import code_remark
from eigengs_dr.bases import load_basis
from eigengs_dr.eigengs import EigenGS
from eigengs_dr.gaussians import Gaussians
from eigengs_dr.metrics import psnr

FILE = "curves.jsonl"

PANELS = {
    "faces256": "faces",
    "cats256": "cats",
    "cars256": "cars",
    "natural256": "ImageNet",
    "kodak": 'Kodak, basis "natural"',
}
"""Sets of the chart of PSNR, and their titles."""

EVERY = 50
"""Iterations between two points of a curve."""


def curves(task: Task) -> Iterator[Figure]:
    """Draw PSNR over iterations of every preset: the paper's figure of curves."""
    marks = sorted({*range(0, task.iterations + 1, EVERY), task.iterations})
    settings = {"iterations": task.iterations, "every": EVERY, "seed": task.seed}
    panels, rows = {}, list[Row]()
    for name in (name for name in PANELS if present(task, name)):
        if name == "kodak":
            model = load_basis("natural", task.backend)
        else:
            model = model_for(task, name, name, COMPONENTS)
        jobs = [
            (
                {"set": name, "image": file, "preset": preset, **settings},
                partial(_curve, task, to_size(image, model), model, preset, marks),
            )
            for file, image in images_of(task, name)
            for preset in METHODS
        ]
        measured = task.measure(FILE, jobs, f"curves of {name}")
        rows += measured
        panels[PANELS[name]] = [
            Curve(preset, marks, _mean([r for r in measured if r["job"]["preset"] == preset]))
            for preset in METHODS
        ]
    figure = curves_chart(panels, "iterations", "PSNR (YCbCr) / dB")
    save_figure(task.folder / "curves.svg", figure)
    caption = (
        f"PSNR in YCbCr every {EVERY} iterations, mean of up to {task.images} test images a set. "
        "The preset eigengs starts from a basis of each set's own training images with "
        f"{COMPONENTS} components a channel, for Kodak from the one that ships."
        f"{code_remark(rows)}"
    )
    yield Figure("curves", "curves.svg", caption)


def _curve(task: Task, image: Image, model: EigenGS, preset: str, marks: Sequence[int]) -> Row:
    """PSNR at every mark."""
    moments = descent(task, image, model, preset, marks)
    return {"psnr_ycbcr": [psnr(moment.picture, image, "ycbcr") for moment in moments]}


def _mean(measured: list[Row]) -> list[float]:
    # A fit that has failed is None in a file, and NaN here.
    return list(np.mean(np.array([row["psnr_ycbcr"] for row in measured], float), axis=0))


def radii(task: Task) -> Iterator[Figure]:
    """Draw how large splats are, with and without the split by frequency: the paper's figure."""
    images, panels = images_of(task, CATS), []
    for split, title in ((False, "no split"), (True, "frequency-aware split")):
        model = model_for(task, CATS, CATS, COMPONENTS, split=split)
        found = []
        for done, (_, image) in enumerate(images):
            task.progress(f"radii, {title}", done, len(images))
            last = list(descent(task, image, model, "eigengs", [task.iterations]))[-1]
            found.append(radii_of(last.gaussians))
        low, high = np.split(np.stack(found), [model.low], axis=1)
        panels.append(Radii(title, low.ravel(), high.ravel(), len(images)))
    save_figure(task.folder / "radii.svg", radii_chart(panels))
    caption = (
        "Radii of the Gaussians (geometric mean of the two standard deviations) after "
        f'{task.iterations:,} iterations of the preset "eigengs", mean of {len(images)} cats. '
        "Right, a tenth of the Gaussians serve the first 50 components."
    )
    yield Figure("radii", "radii.svg", caption)


def radii_of(gaussians: Gaussians) -> NDArray[np.float64]:
    """Geometric mean of the standard deviations of every splat, in pixels, shape (N,)."""
    factor = gaussians.to_arrays()["factor"].astype(np.float64)
    return 1 / np.sqrt(factor[:, 0] * factor[:, 2])  # det F = a c

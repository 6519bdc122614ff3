"""The paper's figures that are charts: PSNR over iterations, and how large splats are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..eigenbasis.eigengs import EigenGS
from ..eigenbasis.registry import load_basis
from ..gaussian.gaussians import Gaussians
from ..image.metrics import psnr
from . import rows, sets
from .figure_pictures import Curve, Radii, save_curves, save_radii
from .figure_task import CATS, COMPONENTS, METHODS, Figure, Image, Task, descent, model_of, to_size

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
    panels = {}
    for name in (name for name in PANELS if name in task.present):
        model = load_basis("natural", task.backend) if name == "kodak" else model_of(task, name)
        jobs = list[rows.Job]()
        for file, image in sets.test_images(task.data, name, task.images):
            for preset in METHODS:
                work = partial(_curve, task, to_size(image, model), model, preset, marks)
                settings = {"iterations": task.iterations, "every": EVERY, "seed": task.seed}
                jobs.append(({"set": name, "image": file, "preset": preset, **settings}, work))
        show = partial(task.progress, f"curves of {name}")
        measured = rows.measure(task.folder / "curves.jsonl", jobs, task.machine, show)
        panels[PANELS[name]] = [
            Curve(preset, marks, _mean([r for r in measured if r["job"]["preset"] == preset]))
            for preset in METHODS
        ]
    save_curves(task.folder / "curves.svg", panels, "iterations", "PSNR (YCbCr) / dB")
    caption = (
        f"PSNR in YCbCr every {EVERY} iterations, mean of up to {task.images} test images a set "
        "of 256x256 pixels, 5,000 Gaussians. The preset eigengs starts from a basis of each set's "
        f"own training images with {COMPONENTS} components a channel, for Kodak from the one that "
        "ships with the package."
    )
    yield Figure("curves", "curves.svg", caption)


def radii(task: Task) -> Iterator[Figure]:
    """Draw how large splats are, with and without the split by frequency: the paper's figure."""
    images = sets.test_images(task.data, CATS, task.images)
    panels = []
    for split, title in ((False, "no split"), (True, "frequency-aware split")):
        model = model_of(task, CATS, split=split)
        found = []
        for done, (_, image) in enumerate(images):
            task.progress(f"radii, {title}", done, len(images))
            last = list(descent(task, image, model, "eigengs", [task.iterations]))[-1]
            found.append(radii_of(last.gaussians))
        low, high = np.split(np.stack(found), [model.low], axis=1)
        panels.append(Radii(title, low.ravel(), high.ravel(), len(images)))
    save_radii(task.folder / "radii.svg", panels)
    caption = (
        "Radii of the Gaussians (geometric mean of the two standard deviations) after "
        f'{task.iterations:,} iterations of the preset "eigengs", mean of {len(images)} images of '
        f"cats of 256x256 pixels. Right, a tenth of the Gaussians serve the first 50 components."
    )
    yield Figure("radii", "radii.svg", caption)


def radii_of(gaussians: Gaussians) -> NDArray[np.float64]:
    """Geometric mean of the standard deviations of every splat, in pixels, shape (N,)."""
    factor = gaussians.to_arrays()["factor"].astype(np.float64)
    return 1 / np.sqrt(factor[:, 0] * factor[:, 2])  # det F = a c


def _curve(task: Task, image: Image, model: EigenGS, preset: str, marks: Sequence[int]) -> rows.Row:
    """PSNR at every mark."""
    moments = descent(task, image, model, preset, marks)
    return {"psnr_ycbcr": [psnr(moment.picture, image, "ycbcr") for moment in moments]}


def _mean(measured: list[rows.Row]) -> list[float]:
    return list(np.mean([row["psnr_ycbcr"] for row in measured], axis=0))

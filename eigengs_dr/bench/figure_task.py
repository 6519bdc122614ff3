"""What the paper's pictures have in common: their records, models and descents.

Everything has the size of the model that is used, 256x256 pixels, and as many Gaussians as it has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..eigenbasis.eigengs import EigenGS
from ..fitting.initializers import initialize
from ..fitting.presets import PRESETS
from ..image.resize import center_crop
from . import rows, sets
from .trial import Moment, follow

CATS, NATURAL = "cats256", "natural256"
"""The set that is shown, and the one of photos of all kinds."""

COMPONENTS = 300
"""Of every channel of the models that are trained: those of the paper's comparisons."""

METHODS = {
    "gaussianimage": "gaussianimage: random start",
    "eigengs": "eigengs: start from the basis",
    "default": "default: placed by the image, colours solved",
}
"""The presets that are compared, and what stands above their pictures."""

Image = NDArray[np.float32]
Progress = Callable[[str, int, int], None]


class Figure(NamedTuple):
    """A file with a picture.

    Attributes
    ----------
    name : str
        What it shows, a key of `eigengs_dr.bench.figures.STUDIES`.
    path : str
        The file, in the folder of the figures.
    caption : str
    credit : str
        Whose images these are, where they must be named.
    """

    name: str
    path: str
    caption: str
    credit: str = ""


class Task(NamedTuple):
    """What all figures are computed from; see `eigengs_dr.bench.figures.run`.

    Attributes
    ----------
    folder : Path
    data : Path
        Folder of the sets.
    present : tuple of str
        Sets that are there.
    machine : dict
    iterations, images, seed : int
    backend : str or None
    progress : callable
    """

    folder: Path
    data: Path
    present: tuple[str, ...]
    machine: rows.Row
    iterations: int
    images: int
    seed: int
    backend: str | None
    progress: Progress


def model_of(task: Task, name: str, split: bool | str = "auto") -> EigenGS:
    """Load or train the model of a set's own images; `split` as for `sets.model_for`."""
    models = task.folder / "models"
    return sets.model_for(
        task.data,
        name,
        name,
        COMPONENTS,
        models,
        split=split,
        progress=task.progress,
        backend=task.backend,
    )


def descent(
    task: Task,
    image: Image,
    model: EigenGS,
    preset: str,
    marks: Sequence[int],
    color: str = "ycbcr",
) -> Iterator[Moment]:
    """Fit an image by a preset and yield what it comes to.

    Parameters
    ----------
    task : Task
    image : ndarray of float32, shape (H, W, 3)
    model : EigenGS
        Where "eigengs" starts; all presets get as many splats as it has.
    preset : str
    marks : sequence of int
        Iterations after which to yield.
    color : str, optional
    """
    start = partial(
        initialize,
        image,
        len(model.gaussians),
        "auto",
        model,
        PRESETS[preset],
        color=color,
        seed=task.seed,
        backend=task.backend,
    )
    return follow(start, PRESETS[preset].schedule, task.iterations, marks)


def to_size(image: Image, model: EigenGS) -> Image:
    """Bring the largest centred part of an image to the size of a model."""
    return center_crop(image, model.gaussians.width, model.gaussians.height)


def size_of(model: EigenGS) -> str:
    """Write how many splats fits have, and their size."""
    shapes = model.gaussians
    return f"{len(shapes):,} Gaussians, {shapes.width}x{shapes.height} pixels"

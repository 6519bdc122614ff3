"""The sets of images that benchmarks run on, and the models trained on them.

The images are not part of this package. A folder of data has one folder a set, with the images to
train on in ``train/`` and others, to measure on, in ``test/``; or, where nothing is trained, with
the images themselves.
"""

from __future__ import annotations

from pathlib import Path

from eigengs_bench.harness.task import Progress, Task, no_progress
from eigengs_bench.harness.timing import Image
from eigengs_bench.names import SAMPLES, SETS, ImageSet
from eigengs_dr.eigengs import EigenGS
from eigengs_dr.images import image_files, load_image, sample
from eigengs_dr.pca import Eigenbasis
from eigengs_dr.resampling import cropped

SAMPLE_NAMES, SAMPLE_SIDE = ("chelsea", "coffee", "astronaut"), 256
"""The photos of the set `SAMPLES`, and the side in pixels that their middle is brought to."""

MAX_COMPONENTS = 500
"""Components that are computed of every set: models of fewer take the first of them."""


def images_of(task: Task, name: str, count: int | None = None) -> list[tuple[str, Image]]:
    """Load the first images of a set that fits are measured on.

    Parameters
    ----------
    task : Task
    name : str
        One of `SETS`, or `SAMPLES`, which needs no data.
    count : int, optional
        How many, at most; by default `task.images`.

    Returns
    -------
    list of (str, ndarray of float32, shape (H, W, 3))
        Names of the files and RGB, in the order of the names. A portrait has the size of its set
        turned by a quarter.

    Raises
    ------
    ImageError
        If there is no such folder or an image cannot be read.
    ValueError
        If the set needs a folder of data.
    """
    count = task.images if count is None else count
    if name == SAMPLES:
        names = SAMPLE_NAMES[:count]
        return [(photo, cropped(sample(photo), SAMPLE_SIDE, SAMPLE_SIDE)) for photo in names]
    if task.data is None:
        raise ValueError(f"set {name!r} needs DATA, the folder that holds it")
    chosen = SETS[name]
    folder = task.data / chosen.folder
    files = image_files(folder / "test" if (folder / "test").is_dir() else folder)[:count]
    return [(file.name, _upright(load_image(file), chosen)) for file in files]


def has_training_images(data: Path | None, name: str) -> bool:
    """Tell whether a folder of data has images of a set to train on."""
    return bool(data and name in SETS and (data / SETS[name].folder / "train").is_dir())


def model_for(
    task: Task,
    name: str,
    source: str,
    components: int,
    color: str = "ycbcr",
    split: bool | str = "auto",
) -> EigenGS:
    """Load a model of one set's training images at another set's size, or train it first.

    Bases and models are kept in ``models/`` of the task's folder.

    Parameters
    ----------
    task : Task
    name : str
        The set that the model is used on: its size and number of splats.
    source : str
        The set whose ``train/`` it is trained on.
    components : int
        Of each channel.
    color : {"ycbcr", "rgb"}, optional
    split : bool or "auto", optional
        As `frequency_aware` of `EigenGS.fit`.

    Raises
    ------
    ImageError
        If there are no images to train on.
    """
    used, models = SETS[name], task.folder / "models"
    size = f"{used.width}x{used.height}"
    kind = "auto" if isinstance(split, str) else "split" if split else "whole"
    path = models / f"{source}-{size}-{color}-{components}-{used.gaussians}-{kind}.npz"
    if not path.exists():
        models.mkdir(parents=True, exist_ok=True)
        basis = _basis_for(
            Path(task.data or "") / SETS[source].folder / "train",
            models / f"{source}-{size}-{color}-basis.npz",
            (used.width, used.height),
            color,
            task.progress,
        )
        task.progress(path.stem, 0, 1)
        fitted = EigenGS.fit(
            basis.truncated(components), used.gaussians, frequency_aware=split, backend=task.backend
        )
        fitted.save(path)
    # Weights are stored in half precision: the file is used in the first run too.
    return EigenGS.load(path, task.backend)


def _basis_for(
    images: Path, path: Path, size: tuple[int, int], color: str, progress: Progress = no_progress
) -> Eigenbasis:
    if not path.exists():
        basis = Eigenbasis.from_images(
            images,
            size,
            MAX_COMPONENTS,
            color=color,
            progress=lambda done, total, row: progress(path.stem, done, total or 0),
        )
        basis.save(path)
    return Eigenbasis.load(path)


def _upright(picture: Image, chosen: ImageSet) -> Image:
    """Bring an image to the size of its set, portraits to that of a portrait."""
    sides = (chosen.width, chosen.height)
    upright = picture.shape[0] > picture.shape[1]
    return cropped(picture, min(sides), max(sides)) if upright else cropped(picture, *sides)

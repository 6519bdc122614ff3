"""The sets of images that benchmarks run on, and the models trained on them.

A folder of data has one folder per set. It holds images to train on in ``train/`` and others, to
measure on, in ``test/``; or, where nothing is trained, the images themselves.
"""

from pathlib import Path

import eigengs_dr as eg
from eigengs_bench.clock import Image
from eigengs_bench.names import SAMPLES, SETS
from eigengs_bench.rows import Task
from eigengs_dr.image.folder import image_files
from eigengs_dr.image.resize import center_crop

SAMPLE_NAMES = ("chelsea", "coffee", "astronaut")
MAX_COMPONENTS = 500  # of the basis of a set: models with fewer take the first of them


def images_of(task: Task, name: str, count: int | None = None) -> list[tuple[str, Image]]:
    """Load names and pixels of the first images of a set, by default `task.images` images.

    Portraits have the sides of the set swapped. `ImageError` if the set is not there.
    """
    count, sides = task.images if count is None else count, SETS[name][1:3]
    if name == SAMPLES:
        return [(photo, center_crop(eg.sample(photo), *sides)) for photo in SAMPLE_NAMES[:count]]
    folder, pictures = Path(task.data or "") / SETS[name].folder, []
    for file in image_files(folder / "test" if (folder / "test").is_dir() else folder)[:count]:
        picture = eg.load_image(file)
        upright = picture.shape[0] > picture.shape[1]
        size = (min(sides), max(sides)) if upright else sides
        pictures.append((file.name, center_crop(picture, *size)))
    return pictures


def is_present(task: Task, name: str) -> bool:
    """Return whether a set exists, with images to train on if models are trained on it."""
    if task.data is None or name == SAMPLES:
        return task.data is None and name == SAMPLES
    return is_trained(task, name) or (name == "kodak" and (task.data / name).is_dir())


def is_trained(task: Task, name: str) -> bool:
    """Return whether the folder of data has images of a set to train on."""
    return bool(task.data) and (Path(task.data or "") / SETS[name].folder / "train").is_dir()


def model_for(
    task: Task,
    name: str,
    source: str,
    components: int,
    space: str = "ycbcr",
    split: bool | str = "auto",
) -> eg.EigenGS:
    """Load a model of the training images of the set `source`, for images of the set `name`.

    It is trained first if it is not in ``models/`` of the task's folder. `components` are those of
    each channel; `split` is `frequency_aware` of `EigenGS.fit`.
    """
    used, models = SETS[name], task.folder / "models"
    stem = f"{source}-{used.width}x{used.height}-{space}"
    kind = "auto" if isinstance(split, str) else "split" if split else "whole"
    path = models / f"{stem}-{components}-{used.gaussians}-{kind}.npz"
    if not path.exists():
        models.mkdir(parents=True, exist_ok=True)
        basis = models / f"{stem}-basis.npz"
        if not basis.exists():
            eg.Eigenbasis.from_images(
                Path(task.data or "") / SETS[source].folder / "train",
                (used.width, used.height),
                MAX_COMPONENTS,
                space=space,
                progress=lambda done, total, row: task.progress(basis.stem, done, total or 0),
            ).save(basis)
        task.progress(path.stem, 0, 1)
        kept = eg.Eigenbasis.load(basis).truncated(components)
        eg.EigenGS.fit(kept, used.gaussians, frequency_aware=split, backend=task.backend).save(path)
    # Weights are stored in half precision: the file is used in the first run too.
    return eg.EigenGS.load(path, task.backend)

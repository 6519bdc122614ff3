"""The sets of images that benchmarks run on, and the models trained on them.

The images are not part of this package. A folder of data has one folder a set, with the images to
train on in ``train/`` and others, to measure on, in ``test/``; or, where nothing is trained, with
the images themselves.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..eigenbasis.basis import Eigenbasis
from ..eigenbasis.eigengs import EigenGS
from ..image.folder import image_files
from ..image.io import load_image
from ..image.resize import center_crop

Image = NDArray[np.float32]
Progress = Callable[[str, int, int], None]


class ImageSet(NamedTuple):
    """Images of one kind and size.

    Attributes
    ----------
    folder : str
        Where they are, below the folder of data.
    width, height : int
        Pixels that images are brought to, the largest centred part of them.
    gaussians : int
        Splats that the paper uses at this size.
    """

    folder: str
    width: int
    height: int
    gaussians: int


SETS = {
    "faces256": ImageSet("faces256", 256, 256, 5000),
    "cats256": ImageSet("cats512", 256, 256, 5000),
    "cars256": ImageSet("cars256", 256, 256, 5000),
    "natural256": ImageSet("natural256", 256, 256, 5000),
    "cats512": ImageSet("cats512", 512, 512, 20000),
    "kodak": ImageSet("kodak", 768, 512, 20000),
}
"""The sets by name: the paper's kinds of images at its two sizes, and photos that may be shown."""

UNIVERSAL = "natural256"
"""What the paper's "universal" basis is trained on: photos of all kinds."""

MOST_COMPONENTS = 500
"""Components that are computed of every set: models of fewer take the first of them."""


def test_images(data: Path, name: str, count: int) -> list[tuple[str, Image]]:
    """Load the first images that a set is measured on.

    Parameters
    ----------
    data : Path
        The folder of data.
    name : str
        One of `SETS`.
    count : int
        How many, at most.

    Returns
    -------
    list of (str, ndarray of float32, shape (H, W, 3))
        Names of the files and RGB, in the order of the names.

    Raises
    ------
    ImageError
        If there is no such folder or an image cannot be read.
    """
    chosen = SETS[name]
    folder = data / chosen.folder
    files = image_files(folder / "test" if (folder / "test").is_dir() else folder)[:count]
    pictures = ((file.name, load_image(file)) for file in files)
    return [(name, _upright(picture, chosen)) for name, picture in pictures]


def _upright(picture: Image, chosen: ImageSet) -> Image:
    """Bring an image to the size of its set, portraits to that of a portrait."""
    sides = (chosen.width, chosen.height)
    upright = picture.shape[0] > picture.shape[1]
    return center_crop(picture, min(sides), max(sides)) if upright else center_crop(picture, *sides)


def model_for(
    data: Path,
    name: str,
    source: str,
    components: int,
    models: Path,
    color: str = "ycbcr",
    split: bool | str = "auto",
    progress: Progress = lambda label, done, total: None,
    backend: str | None = None,
) -> EigenGS:
    """Load a model of one set's training images at another set's size, or train it first.

    Parameters
    ----------
    data : Path
        The folder of data.
    name : str
        The set that the model is used on: its size and number of splats.
    source : str
        The set whose ``train/`` it is trained on.
    components : int
        A channel.
    models : Path
        Folder of the models and bases that were trained already.
    color : {"ycbcr", "rgb"}, optional
    split : bool or "auto", optional
        As `frequency_aware` of `EigenGS.fit`.
    progress : callable, optional
        ``progress(label, done, total)``.
    backend : {"llvm", "cuda"}, optional

    Raises
    ------
    ImageError
        If there are no images to train on.
    """
    used = SETS[name]
    size = f"{used.width}x{used.height}"
    kind = "auto" if isinstance(split, str) else "split" if split else "whole"
    path = models / f"{source}-{size}-{color}-{components}-{used.gaussians}-{kind}.npz"
    if not path.exists():
        models.mkdir(parents=True, exist_ok=True)
        basis = _basis_for(data, source, (used.width, used.height), models, color, progress)
        progress(path.stem, 0, 1)
        fitted = EigenGS.fit(
            basis.truncated(components), used.gaussians, frequency_aware=split, backend=backend
        )
        fitted.save(path)
    # Weights are stored in half precision: the file is used in the first run too.
    return EigenGS.load(path, backend)


def _basis_for(
    data: Path, source: str, size: tuple[int, int], models: Path, color: str, progress: Progress
) -> Eigenbasis:
    path = models / f"{source}-{size[0]}x{size[1]}-{color}-basis.npz"
    if not path.exists():
        basis = Eigenbasis.from_images(
            data / SETS[source].folder / "train",
            size,
            MOST_COMPONENTS,
            color=color,
            progress=lambda done, total, row: progress(path.stem, done, total or 0),
        )
        basis.save(path)
    return Eigenbasis.load(path)

"""The paper's figures that are rows of pictures: fits on their way, and the use of Gaussians.

All pictures have the size of the model, 256x256 pixels, and its number of Gaussians.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eigengs_bench.harness.datasets import images_of, is_trained, model_for
from eigengs_bench.harness.store import Task
from eigengs_bench.harness.timing import Image, Moment, descent
from eigengs_bench.names import CATS, NATURAL, SETS
from eigengs_bench.report.charts import CELL, Cell, save_strip, strip
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.image.io import sample
from eigengs_dr.image.metrics import psnr
from eigengs_dr.image.resize import center_crop
from eigengs_dr.raster.render import picture_of
from eigengs_dr.viewer.pictures import overlay

CREDIT = "AFHQ, NAVER Corp., CC BY-NC 4.0"  # of all pictures of cats
COMPONENTS = 300  # a channel of the models that are trained, as in the paper's comparisons
PHOTO = "coffee"  # photo of scikit-image that the basis "natural" was not trained on
# The presets that are compared, and what stands above their pictures.
METHODS = {
    "gaussianimage": "gaussianimage: random start",
    "eigengs": "eigengs: start from the basis",
    "default": "default: placed by the image, colours solved",
}
MAGNIFIED = 8  # factor of an error before it is added to mid-grey
MARGIN = 0.08  # around the middle of a picture, in its sides: Gaussians there reach into it

Rows = Sequence[tuple[str, Sequence[Cell]]]


class Figure(NamedTuple):
    """A file with a picture: one of `FIGURES`, the name of the file, and whose images these are."""

    name: str
    path: str
    caption: str
    credit: str = ""


def is_present(task: Task, name: str) -> bool:
    """Tell whether a set is there, with images to train on where models are trained on them."""
    if task.data is None:
        return False
    folder = task.data / SETS[name].folder
    needed = folder if name == "kodak" else folder / "test"
    return needed.is_dir() and (name == "kodak" or is_trained(task.data, name))


def preset_descent(
    task: Task, image: Image, model: EigenGS, preset: str, marks: Sequence[int], **options: Any
) -> Iterator[Moment]:
    """Fit by a preset with the number of Gaussians of a model; "eigengs" starts from it."""
    start, count = model if preset == "eigengs" else None, len(model.gaussians)
    shared = {"gaussians": count, "seed": task.seed, "backend": task.backend}
    return descent(image, task.iterations, marks, preset=preset, start=start, **shared, **options)


def to_size(image: Image, model: EigenGS) -> Image:
    """Bring the largest centred part of an image to the size of a model."""
    return center_crop(image, model.gaussians.width, model.gaussians.height)


def _draw(task: Task, figure: Figure, rows: Rows, side: int = CELL) -> Figure:
    save_strip(task.folder / figure.path, strip(rows, figure.credit, side))
    return figure


def iterations(task: Task) -> Iterator[Figure]:
    """Show the first iterations of every preset: the paper's figures of convergence."""
    marks = [n for n in (0, 10, 100) if n < task.iterations] + [task.iterations]
    for path, image, model, words, credit in _subjects(task):
        rows = []
        for done, (preset, heading) in enumerate(METHODS.items()):
            task.progress(path, done, len(METHODS))
            moments = preset_descent(task, image, model, preset, marks)
            cells = [(f"{_at(m)}: {_decibels(image, m.picture)}", m.picture) for m in moments]
            rows.append((heading, [*cells, ("photo", image)]))
        caption = f"{words} {_size(model)}, after {_listed(marks)} iterations; PSNR in YCbCr."
        yield _draw(task, Figure("iterations", path, caption, credit), rows)


def _subjects(task: Task) -> Iterator[tuple[str, Image, EigenGS, str, str]]:
    """Files, images, models, words and credits of what `iterations` shows."""
    shipped = EigenGS.load("natural", task.backend)
    photos = [("A photo of scikit-image", PHOTO, sample(PHOTO))]
    if is_present(task, "kodak"):
        [(file, image)] = images_of(task, "kodak", 1)
        photos.append(("A Kodak photo", Path(file).stem, image))
    for words, name, image in photos:
        words = f'{words} and the basis "natural".'
        yield f"iterations-{name}.jpg", to_size(image, shipped), shipped, words, ""
    if is_present(task, CATS):
        [(_, image)] = images_of(task, CATS, 1)
        words = f"A cat and a basis of other cats with {COMPONENTS} components a channel."
        yield "cats-iterations-1.png", image, _cats(task), words, CREDIT


def colors(task: Task) -> Iterator[Figure]:
    """Compare fits in YCbCr and in RGB: the paper's figures of colour spaces."""
    model = EigenGS.load("natural", task.backend)
    image = to_size(sample(PHOTO), model)
    marks, rows = sorted({min(10, task.iterations), task.iterations}), []
    for done, (color, heading) in enumerate({"ycbcr": "YCbCr", "rgb": "RGB"}.items()):
        task.progress("colors", done, 2)
        cells = [("photo", image)]
        for moment in preset_descent(task, image, model, "default", marks, space=color):
            one, other = (psnr(moment.picture, image, space) for space in ("ycbcr", "rgb"))
            error = 0.5 + MAGNIFIED * (moment.picture - image)
            cells.append((f"{_at(moment)}: {one:.1f} / {other:.1f}", moment.picture))
            cells.append((f"{MAGNIFIED} x its error", error))
        rows.append((f"fitted in {heading}; PSNR in YCbCr / in RGB, in dB", cells))
    caption = (
        'A photo of scikit-image, fitted by the preset "default" in YCbCr and in RGB: '
        f"{_size(model)}, after {_listed(marks)} iterations; the error is magnified {MAGNIFIED} "
        "times, around grey."
    )
    yield _draw(task, Figure("colors", "colors.jpg", caption), rows)


def split(task: Task) -> Iterator[Figure]:
    """Show what Gaussians for low and for high frequencies make: the paper's figure of both."""
    model, [(_, image)] = _cats(task, split=True), images_of(task, CATS, 1)
    encoded = model.encode(image)
    whole, low = picture_of(encoded), picture_of(encoded[: model.low])
    high = 0.5 + whole - low
    top = [
        ("photo", image),
        (f"{model.low:,} for low frequencies", low),
        (f"{len(encoded) - model.low:,} for high, around grey", high),
    ]
    bottom = [
        (f"both: {_decibels(image, whole)}", whole),
        ("their outlines in the middle, x 2", _outlines(encoded[: model.low], low)),
        ("their outlines in the middle, x 2", _outlines(encoded[model.low :], high)),
    ]
    caption = (
        "A cat encoded by a model with the frequency-aware split: pictures of its Gaussians for "
        "low and for high frequencies alone, and their outlines at one standard deviation."
    )
    figure = Figure("split", "cats-split.png", caption, CREDIT)
    yield _draw(task, figure, [("", top), ("", bottom)], 256)


def cross(task: Task) -> Iterator[Figure]:
    """Show cats projected on bases of other images: the paper's figure of cross-dataset starts."""
    bases = {
        "cats": _cats(task),
        "ImageNet": model_for(task, NATURAL, NATURAL, COMPONENTS),
        '"natural"': EigenGS.load("natural", task.backend),
    }
    heading = "photos, and at iteration 0 from bases of cats, of ImageNet, and the one that ships"
    rows = list[tuple[str, list[Cell]]]()
    for _, image in images_of(task, CATS, 3):
        cells = [("photo", image)]
        for words, model in bases.items():
            shown = picture_of(model.encode(image, "projected"))
            cells.append((f"{words}: {_decibels(image, shown)}", shown))
        rows.append(("" if rows else heading, cells))
    caption = (
        "Cats at iteration 0: projected on bases of other cats, of photos of ImageNet classes "
        f"({COMPONENTS} components a channel each), and on the one that ships; PSNR in YCbCr."
    )
    yield _draw(task, Figure("cross", "cats-cross.png", caption, CREDIT), rows)


def _cats(task: Task, **options: Any) -> EigenGS:
    return model_for(task, CATS, CATS, COMPONENTS, **options)


def _outlines(gaussians: Gaussians, picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Outlines over the middle quarter of a picture, which has room for all of them."""
    height, width = picture.shape[:2]
    away = np.abs(gaussians.to_arrays()["mean"] / (width, height) - 0.5)
    near = gaussians[(away < 0.25 + MARGIN).all(axis=1)]
    large = picture.repeat(4, axis=0).repeat(4, axis=1)
    return overlay(near, large)[height : 3 * height, width : 3 * width]


def _size(model: EigenGS) -> str:
    shapes = model.gaussians
    return f"{len(shapes):,} Gaussians, {shapes.width}x{shapes.height} pixels"


def _listed(marks: Sequence[int]) -> str:
    return " and ".join(", ".join(f"{mark:,}" for mark in marks).rsplit(", ", 1))


def _at(moment: Moment) -> str:
    return f"iteration {moment.iteration:,}"


def _decibels(image: Image, picture: Image) -> str:
    return f"{psnr(picture, image, 'ycbcr'):.1f} dB"

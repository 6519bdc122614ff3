"""The paper's figures that are rows of pictures: fits on their way, and what splats are for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..cli.pictures import overlay
from ..eigenbasis.eigengs import EigenGS
from ..eigenbasis.registry import load_basis
from ..gaussian.gaussians import Gaussians
from ..image.metrics import psnr
from ..image.samples import sample
from ..raster.render import picture_of
from . import sets
from .figure_pictures import Cell, Picture, Row, save_strip, strip
from .figure_task import (
    CATS,
    COMPONENTS,
    METHODS,
    NATURAL,
    Figure,
    Image,
    Task,
    descent,
    model_of,
    size_of,
    to_size,
)
from .trial import Moment

CREDIT = "AFHQ, NAVER Corp., CC BY-NC 4.0"
"""Of all pictures of cats."""

PHOTO = "coffee"
"""Photo of scikit-image that the basis "natural" was not trained on."""

SHOWN = 1
"""Images of a set that are shown."""

MAGNIFIED = 8
"""Factor of an error before it is added to mid-grey."""

MARGIN = 0.08
"""Around the middle of a picture, in its sides: splats there reach into it."""


class Subject(NamedTuple):
    """An image that is shown, its file, the model that encodes it, and what is said of them."""

    path: str
    image: Image
    model: EigenGS
    words: str
    credit: str = ""


def iterations(task: Task) -> Iterator[Figure]:
    """Show the first iterations of every preset: the paper's figures of convergence."""
    marks = sorted({0, 10, 100, task.iterations} & set(range(task.iterations + 1)))
    for subject in _subjects(task):
        image, table = subject.image, []
        for done, (preset, heading) in enumerate(METHODS.items()):
            task.progress(subject.path, done, len(METHODS))
            cells = [
                Cell(f"{_at(moment)}: {_decibels(image, moment.picture)}", moment.picture)
                for moment in descent(task, image, subject.model, preset, marks)
            ]
            table.append(Row(heading, [*cells, Cell("photo", image)]))
        save_strip(task.folder / subject.path, strip(table, subject.credit))
        caption = (
            f"{subject.words} {size_of(subject.model)}, after {_listed(marks)} iterations of three "
            "methods; PSNR in YCbCr."
        )
        yield Figure("iterations", subject.path, caption, subject.credit)


def colors(task: Task) -> Iterator[Figure]:
    """Compare fits in YCbCr and in RGB: the paper's figures of colour spaces."""
    model = load_basis("natural", task.backend)
    image = to_size(sample(PHOTO), model)
    marks, table = sorted({min(10, task.iterations), task.iterations}), []
    for done, (color, heading) in enumerate({"ycbcr": "YCbCr", "rgb": "RGB"}.items()):
        task.progress("colors", done, 2)
        cells = [Cell("photo", image)]
        for moment in descent(task, image, model, "default", marks, color):
            one, other = (psnr(moment.picture, image, space) for space in ("ycbcr", "rgb"))
            error = 0.5 + MAGNIFIED * (moment.picture - image)
            cells += [
                Cell(f"{_at(moment)}: {one:.1f} / {other:.1f}", moment.picture),
                Cell(f"{MAGNIFIED} x its error", error),
            ]
        table.append(Row(f"fitted in {heading}; PSNR in YCbCr / in RGB, in dB", cells))
    save_strip(task.folder / "colors.jpg", strip(table))
    caption = (
        'A photo of scikit-image, fitted by the preset "default" in YCbCr and in RGB: '
        f"{size_of(model)}, after {_listed(marks)} iterations; PSNR in YCbCr / in RGB, and the "
        f"error, magnified {MAGNIFIED} times, around grey."
    )
    yield Figure("colors", "colors.jpg", caption)


def split(task: Task) -> Iterator[Figure]:
    """Show what splats for low and for high frequencies make: the paper's figure of both."""
    model = model_of(task, CATS, split=True)
    [(_, image)] = sets.test_images(task.data, CATS, 1)
    encoded = model.encode(image)
    whole, low = picture_of(encoded), picture_of(encoded[: model.low])
    high = 0.5 + whole - low
    count = len(encoded) - model.low
    top = [
        Cell("photo", image),
        Cell(f"{model.low:,} for low frequencies", low),
        Cell(f"{count:,} for high, around grey", high),
    ]
    bottom = [
        Cell(f"both: {_decibels(image, whole)}", whole),
        Cell("their outlines in the middle, x 2", _outlines(encoded[: model.low], low)),
        Cell("their outlines in the middle, x 2", _outlines(encoded[model.low :], high)),
    ]
    save_strip(task.folder / "cats-split.png", strip([Row("", top), Row("", bottom)], CREDIT, 256))
    caption = (
        "A cat encoded by a model with the frequency-aware split: what its Gaussians for low and "
        "for high frequencies render alone, and their outlines at one standard deviation, in the "
        "middle of the picture and twice as large."
    )
    yield Figure("split", "cats-split.png", caption, CREDIT)


def cross(task: Task) -> Iterator[Figure]:
    """Show images projected on bases of other images: the paper's figure of cross-dataset starts.

    Of `CATS` alone: images of the other sets may not be shown.
    """
    bases = {
        "cats": model_of(task, CATS),
        "ImageNet": model_of(task, NATURAL),
        '"natural"': load_basis("natural", task.backend),
    }
    heading = "photos, and at iteration 0 from bases of cats, of ImageNet, and the one that ships"
    table = list[Row]()
    for _, image in sets.test_images(task.data, CATS, 3):
        cells = [Cell("photo", image)]
        for words, model in bases.items():
            shown = picture_of(model.encode(image, "projected"))
            cells.append(Cell(f"{words}: {_decibels(image, shown)}", shown))
        table.append(Row("" if table else heading, cells))
    save_strip(task.folder / "cats-cross.png", strip(table, CREDIT))
    caption = (
        "Cats at iteration 0: projected on bases of other cats, of photos of ImageNet classes "
        f"({COMPONENTS} components a channel each), and on the one that ships with the package, of "
        "crops of twelve photos; PSNR in YCbCr."
    )
    yield Figure("cross", "cats-cross.png", caption, CREDIT)


def _subjects(task: Task) -> Iterator[Subject]:
    """Images whose first iterations are shown."""
    shipped = load_basis("natural", task.backend)
    words = 'A photo of scikit-image and the basis "natural".'
    yield Subject(f"iterations-{PHOTO}.jpg", to_size(sample(PHOTO), shipped), shipped, words)
    if "kodak" in task.present:
        words = 'A Kodak photo and the basis "natural".'
        for file, image in sets.test_images(task.data, "kodak", SHOWN):
            path = f"iterations-{Path(file).stem}.jpg"
            yield Subject(path, to_size(image, shipped), shipped, words)
    if CATS in task.present:
        words = f"A cat and a basis of other cats with {COMPONENTS} components a channel."
        model = model_of(task, CATS)
        for number, (_, image) in enumerate(sets.test_images(task.data, CATS, SHOWN), 1):
            yield Subject(f"cats-iterations-{number}.png", image, model, words, CREDIT)


def _outlines(gaussians: Gaussians, picture: Picture) -> Picture:
    """Outlines over the middle quarter of a picture, which has room for all of them."""
    height, width = picture.shape[:2]
    away = np.abs(gaussians.to_arrays()["mean"] / (width, height) - 0.5)
    near = gaussians[(away < 0.25 + MARGIN).all(axis=1)]
    large = picture.repeat(4, axis=0).repeat(4, axis=1)
    return overlay(near, large)[height : 3 * height, width : 3 * width]


def _listed(marks: Sequence[int]) -> str:
    """Write numbers as a list: "0, 10 and 1,000"."""
    *first, last = (f"{mark:,}" for mark in marks)
    return f"{', '.join(first)} and {last}" if first else last


def _at(moment: Moment) -> str:
    return f"iteration {moment.iteration:,}"


def _decibels(image: Image, picture: Picture) -> str:
    return f"{psnr(picture, image, 'ycbcr'):.1f} dB"

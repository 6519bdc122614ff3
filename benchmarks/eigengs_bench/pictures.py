"""The paper's curves, histograms and rows of pictures, with our fits, and tiles side by side.

All pictures but the tiles have the size of the model, 256x256 pixels, and its number of Gaussians.
The row of a curve has "psnr_ycbcr" every `EVERY` steps; that of a set of pictures names its file.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from eigengs_bench import report as fr
from eigengs_bench.cases import CASES
from eigengs_bench.clock import METHODS, Image, Moment, descent
from eigengs_bench.images import images_of, is_present, model_for
from eigengs_bench.names import CATS, NATURAL, PICTURES
from eigengs_bench.rows import Job, Row, Task
from eigengs_bench.stability import fit_case
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.image.io import sample
from eigengs_dr.image.metrics import psnr
from eigengs_dr.image.resize import center_crop
from eigengs_dr.raster.render import picture_of
from eigengs_dr.viewer.pictures import overlay

COMPONENTS = 300  # per channel of the models that are trained, as in the paper's comparisons
PHOTO = "coffee"  # photo of scikit-image that the basis "natural" was not trained on
# What stands above the pictures of a method.
HEADINGS = {
    "gaussianimage": "gaussianimage: random start",
    "eigengs": "eigengs: start from the basis",
    "default": "default: placed by the image, colours solved",
}
CURVES = ("faces256", "cats256", "cars256", "natural256", "kodak", "samples")
NEEDS = {"radii": [CATS], "split": [CATS], "cross": [CATS, NATURAL]}
CREDIT = "Images: AFHQ, NAVER Corp., CC BY-NC 4.0"  # of all pictures of cats
EVERY = 50  # iterations between two points of a curve
MAGNIFIED, STRETCHED = 8, 20  # factors of errors before they are added to mid-grey
BORDER = (
    0.08  # around the middle of a picture, relative to its sides: Gaussians there reach into it
)
CELL, LETTERS = 1.8, 0.42  # sides of a picture, and height of the lines around it, in inches

Cell = tuple[str, NDArray[Any]]  # the caption of a picture, and the picture: RGB, not clamped


def run(task: Task, pictures: Sequence[str]) -> list[Row]:
    """Draw pictures into the folder, by default those whose sets of images exist."""
    chosen = pictures or [p for p in PICTURES if all(is_present(task, s) for s in NEEDS.get(p, []))]
    functions = (_iterations, _colors, _curves, _tiles, _radii, _split, _cross)
    makers = dict(zip(PICTURES, functions, strict=True))
    return [row for name in chosen for row in makers[name](task)]


def summarize(rows: Sequence[Row]) -> fr.Section:
    """List the pictures, and draw the curves and the histograms."""
    files = [row for row in rows if "file" in row]
    lines = [(row["file"], row["caption"]) for row in files]
    charts: dict[str, Figure] = {}
    if curves := [row for row in rows if "psnr_ycbcr" in row]:
        charts["curves"] = _curves_chart(curves)
    if histograms := [row for row in rows if "radii" in row]:
        charts["radii"] = _radii_chart(histograms)
    return fr.Section([fr.table("Pictures", ("file", "caption"), lines)], charts)


def preset_descent(
    task: Task, image: Image, model: EigenGS, preset: str, marks: Sequence[int], **options: Any
) -> Iterator[Moment]:
    """Fit by a method with as many Gaussians as a model has; "eigengs" starts from the model."""
    method, count = METHODS[preset], len(model.gaussians)
    start = model if method.needs_model else None
    shared = {"gaussians": count, "backend": task.backend, "method": method, "start": start}
    return descent(image, task.iterations, marks, **shared, **options)


def to_size(image: Image, model: EigenGS) -> Image:
    """Resize the largest centred part of an image to the size of a model."""
    return center_crop(image, model.gaussians.width, model.gaussians.height)


# ---------------------------------------------------------------------------------------------
#  Curves and histograms
# ---------------------------------------------------------------------------------------------


def _curves(task: Task) -> list[Row]:
    """Measure PSNR over iterations of every method: the paper's figure of curves."""
    present = [name for name in CURVES if is_present(task, name)]
    return task.measure("pictures", [job for name in present for job in _curve_jobs(task, name)])


def _curve_jobs(task: Task, name: str) -> Iterator[Job]:
    model = EigenGS.load("natural", task.backend)
    if name not in ("kodak", "samples"):
        model = model_for(task, name, name, COMPONENTS)
    marks = sorted({*range(0, task.iterations + 1, EVERY), task.iterations})

    def work(image: Image, preset: str) -> Row:
        moments = preset_descent(task, image, model, preset, marks)
        return {"psnr_ycbcr": [psnr(m.picture, image, "ycbcr") for m in moments], "marks": marks}

    for file, image in images_of(task, name):
        for preset in HEADINGS:
            label = {"set": name, "image": file, "preset": preset, "iterations": task.iterations}
            yield label, partial(work, to_size(image, model), preset)


def _curves_chart(rows: Sequence[Row]) -> Figure:
    """Draw lines in the colours of the methods, one panel per set: means over its images."""
    names = list(dict.fromkeys(row["job"]["set"] for row in rows))
    columns = min(3, len(names))
    lines = -(-len(names) // columns)
    figure = fr.new_figure(8, 0.6 + 2.4 * lines)
    axes = figure.subplots(lines, columns, squeeze=False, sharey=True).ravel()
    for axis in axes[len(names) :]:
        axis.set_axis_off()
    for axis, name in zip(axes, names, strict=False):
        for preset in HEADINGS:
            job = {"set": name, "preset": preset}
            some = [row for row in rows if job.items() <= row["job"].items()]
            # A fit that has failed is None in a file, and NaN here.
            means = np.mean(np.array([row["psnr_ycbcr"] for row in some], float), axis=0)
            axis.plot(some[0]["marks"], means, label=preset, color=fr.COLORS[preset])
        fr.label_axes(axis, "iterations", "PSNR (YCbCr) / dB", "", False, title=name)
    fr.legend_below(figure, axes[0], len(HEADINGS))
    return figure


def _radii(task: Task) -> list[Row]:
    """Measure how large Gaussians are, with and without the split by frequency."""

    def work(split: bool) -> Row:
        model, radii = model_for(task, CATS, CATS, COMPONENTS, split=split), []
        for _, image in images_of(task, CATS):
            *_, last = preset_descent(task, image, model, "eigengs", [task.iterations])
            radii.append(radii_of(last.gaussians).round(3))
        return {"radii": np.stack(radii), "low": model.low}

    jobs: list[Job] = [
        (
            {"radii": title, "images": task.images, "iterations": task.iterations},
            partial(work, split),
        )
        for title, split in (("no split", False), ("frequency-aware split", True))
    ]
    return task.measure("pictures", jobs)


def radii_of(gaussians: Gaussians) -> NDArray[np.float64]:
    """Return the geometric mean of the standard deviations of every Gaussian, in pixels, (N,)."""
    factor = gaussians.to_arrays()["factor"].astype(np.float64)
    return 1 / np.sqrt(factor[:, 0] * factor[:, 2])  # det F = a c


def _radii_chart(rows: Sequence[Row]) -> Figure:
    """Draw histograms of radii side by side: Gaussians for low frequencies, and all others."""
    figure = fr.new_figure(3.8 * len(rows), 3.2)
    axes = figure.subplots(1, len(rows), squeeze=False, sharex=True, sharey=True)[0]
    bins = np.linspace(0, 1.05 * max(np.max(row["radii"]) for row in rows), 60)
    for axis, row in zip(axes, rows, strict=True):
        low, high = np.split(np.array(row["radii"]), [row["low"]], axis=1)
        name = "high frequencies" if low.size else "all"
        for part, label, color in ((high, name, fr.BLUE), (low, "low frequencies", fr.RED)):
            if part.size:
                weights = np.full(part.size, 1 / len(part))
                label = f"{label}: {part.shape[1]:,} Gaussians"
                axis.hist(part.ravel(), bins, weights=weights, color=color, label=label, alpha=0.8)
        axis.margins(y=0.35)  # room for the legend
        title = row["job"]["radii"]
        fr.label_axes(axis, "radius / pixels", "Gaussians of an image", "", title=title)
        axis.set_yscale("log")
    return figure


# ---------------------------------------------------------------------------------------------
#  Rows of pictures
# ---------------------------------------------------------------------------------------------


def _draw_rows(
    task: Task, file: str, caption: str, make: Callable[[], list[tuple[str, Sequence[Cell]]]]
) -> list[Row]:
    """Draw rows of pictures into a file, once; pictures of cats carry a line of credit."""

    def work() -> Row:
        rows = make()
        credit = CREDIT if file.startswith("cats") else ""
        fr.save_figure(task.folder / file, strip(rows, credit))
        return {"file": file, "caption": caption}

    return task.measure("pictures", [({"file": file, "iterations": task.iterations}, work)])


def _iterations(task: Task) -> list[Row]:
    """Show the first iterations of every method: the paper's figures of convergence."""
    marks = [n for n in (0, 10, 100) if n < task.iterations] + [task.iterations]
    file, words, photo = f"iterations-{PHOTO}.jpg", 'a photo and the basis "natural"', sample(PHOTO)
    model = EigenGS.load("natural", task.backend)
    if is_present(task, CATS):
        file, words = "cats-iterations.png", "a cat and a basis of other cats"
        [(_, photo)] = images_of(task, CATS, 1)
        model = model_for(task, CATS, CATS, COMPONENTS)
    image = to_size(photo, model)

    def make() -> list[tuple[str, Sequence[Cell]]]:
        rows: list[tuple[str, Sequence[Cell]]] = []
        for preset, heading in HEADINGS.items():
            cells = [_cell_of(m, image) for m in preset_descent(task, image, model, preset, marks)]
            rows.append((heading, [*cells, ("photo", image)]))
        return rows

    caption = f"Iterations of every method: {words}, {_size(model)}; PSNR in YCbCr"
    return _draw_rows(task, file, caption, make)


def _colors(task: Task) -> list[Row]:
    """Compare fits in YCbCr and in RGB: the paper's figures of colour spaces."""
    model = EigenGS.load("natural", task.backend)
    image = to_size(sample(PHOTO), model)
    marks = sorted({min(10, task.iterations), task.iterations})

    def make() -> list[tuple[str, Sequence[Cell]]]:
        rows: list[tuple[str, Sequence[Cell]]] = []
        for space, heading in {"ycbcr": "YCbCr", "rgb": "RGB"}.items():
            cells: list[Cell] = [("photo", image)]
            for moment in preset_descent(task, image, model, "default", marks, space=space):
                one, other = (psnr(moment.picture, image, s) for s in ("ycbcr", "rgb"))
                error = 0.5 + MAGNIFIED * (moment.picture - image)
                line = f"iteration {moment.iteration:,}: {one:.1f} / {other:.1f}"
                cells += [(line, moment.picture), (f"{MAGNIFIED} x its error", error)]
            rows.append((f"fitted in {heading}; PSNR in YCbCr / in RGB, in dB", cells))
        return rows

    caption = f"A photo fitted in YCbCr and in RGB by the method default: {_size(model)}"
    return _draw_rows(task, "colors.jpg", caption, make)


def _tiles(task: Task) -> list[Row]:
    """Show the middle of a slow gradient by every method, where Gaussians show as round tiles."""

    def make() -> list[tuple[str, Sequence[Cell]]]:
        case = CASES["smooth"]._replace(iterations=task.iterations)
        image = case.image()
        middle = (slice(len(image) // 3, 2 * len(image) // 3),) * 2
        cells, errors = [], []
        for preset in HEADINGS:
            picture = fit_case(case, image, preset, task.backend).image
            cells.append((f"{preset}: {psnr(picture, image, 'ycbcr'):.1f} dB", picture[middle]))
            errors.append(("", (0.5 + STRETCHED * (picture - image))[middle]))
        return [("", cells), (f"their errors times {STRETCHED}", errors)]

    caption = f"The middle of a slow gradient after {task.iterations:,} steps; PSNR in YCbCr"
    return _draw_rows(task, "tiles.png", caption, make)


def _split(task: Task) -> list[Row]:
    """Show what Gaussians for low and for high frequencies make: the paper's figure of both."""

    def make() -> list[tuple[str, Sequence[Cell]]]:
        model = model_for(task, CATS, CATS, COMPONENTS, split=True)
        [(_, image)] = images_of(task, CATS, 1)
        encoded = model.encode(image)
        whole, low = picture_of(encoded), picture_of(encoded[: model.low])
        high, outlines = 0.5 + whole - low, "their outlines in the middle, x 2"
        top = [
            ("photo", image),
            (f"{model.low:,} for low frequencies", low),
            (f"{len(encoded) - model.low:,} for high, around grey", high),
        ]
        bottom = [
            (f"both: {psnr(whole, image, 'ycbcr'):.1f} dB", whole),
            (outlines, _outlines(encoded[: model.low], low)),
            (outlines, _outlines(encoded[model.low :], high)),
        ]
        return [("", top), ("", bottom)]

    caption = "A cat encoded by a model with the frequency-aware split, and outlines of Gaussians"
    return _draw_rows(task, "cats-split.png", caption, make)


def _cross(task: Task) -> list[Row]:
    """Show cats projected on bases of other images: the paper's figure of cross-dataset starts."""

    def make() -> list[tuple[str, Sequence[Cell]]]:
        bases = {
            "cats": model_for(task, CATS, CATS, COMPONENTS),
            "ImageNet": model_for(task, NATURAL, NATURAL, COMPONENTS),
            '"natural"': EigenGS.load("natural", task.backend),
        }
        rows: list[tuple[str, Sequence[Cell]]] = []
        for _, image in images_of(task, CATS, 3):
            cells: list[Cell] = [("photo", image)]
            for words, model in bases.items():
                projected = picture_of(model.encode(image, "projected"))
                cells.append((f"{words}: {psnr(projected, image, 'ycbcr'):.1f} dB", projected))
            rows.append(("", cells))
        return rows

    caption = "Cats at iteration 0: projected on bases of cats, of ImageNet, and the one that ships"
    return _draw_rows(task, "cats-cross.png", caption, make)


def _cell_of(moment: Moment, image: Image) -> Cell:
    reached = psnr(moment.picture, image, "ycbcr")
    return f"iteration {moment.iteration:,}: {reached:.1f} dB", moment.picture


def _size(model: EigenGS) -> str:
    shapes = model.gaussians
    return f"{len(shapes):,} Gaussians, {shapes.width}x{shapes.height} pixels"


def _outlines(gaussians: Gaussians, picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Draw outlines over the middle quarter of a picture, enlarged to make room for them."""
    height, width = picture.shape[:2]
    away = np.abs(gaussians.to_arrays()["mean"] / (width, height) - 0.5)
    near = gaussians[(away < 0.25 + BORDER).all(axis=1)]
    large = picture.repeat(4, axis=0).repeat(4, axis=1)
    return overlay(near, large)[height : 3 * height, width : 3 * width]


def strip(rows: Sequence[tuple[str, Sequence[Cell]]], credit: str = "") -> Figure:
    """Stack rows of pictures, each below its heading."""
    columns = max(len(cells) for _, cells in rows)
    figure = fr.new_figure(CELL * columns, (CELL + LETTERS) * len(rows))
    figure.supxlabel(credit, fontsize=7)
    parts = figure.subfigures(len(rows), 1, squeeze=False)[:, 0]
    for part, (heading, cells) in zip(parts, rows, strict=True):
        part.suptitle(heading, fontsize=9)
        for axis, (caption, picture) in zip(
            part.subplots(1, len(cells), squeeze=False)[0], cells, strict=True
        ):
            axis.imshow(np.clip(picture, 0, 1))
            axis.set(xticks=[], yticks=[], frame_on=False)
            axis.set_xlabel(caption, fontsize=7)
    return figure

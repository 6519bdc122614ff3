"""The paper's curves with our fits, and pictures of tiles side by side.

The row of a curve has "psnr_ycbcr" every `EVERY` steps, of a fit with the size of the model and its
number of Gaussians; that of the tiles names its file.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import eigengs_dr as eg
from eigengs_bench import report as fr
from eigengs_bench.cases import CASES
from eigengs_bench.clock import METHODS, Image, descent
from eigengs_bench.images import images_of, is_present, model_for
from eigengs_bench.names import PICTURES
from eigengs_bench.rows import Job, Row, Task
from eigengs_bench.stability import fit_case
from eigengs_dr.image.resize import center_crop

COMPONENTS = 300  # per channel of the models that are trained, as in the paper's comparisons
PRESETS = ("gaussianimage", "eigengs", "default")
CURVES = ("faces256", "cats256", "cars256", "natural256", "kodak", "samples")
EVERY = 50  # iterations between two points of a curve
TILES, STRETCHED = "tiles.png", 20  # a file, and the factor of errors in it before they are added
CELL, LETTERS = 1.8, 0.42  # sides of a picture, and height of the lines around it, in inches

Cell = tuple[str, NDArray[Any]]  # the caption of a picture, and the picture: RGB, not clamped


def run(task: Task, pictures: Sequence[str]) -> list[Row]:
    """Draw curves and tiles into the folder, or some of them."""
    makers = {"curves": _curves, "tiles": _tiles}
    return [row for name in pictures or PICTURES for row in makers[name](task)]


def summarize(rows: Sequence[Row]) -> fr.Section:
    """List the pictures, and draw the curves."""
    lines = [(row["file"], row["caption"]) for row in rows if "file" in row]
    curves = [row for row in rows if "psnr_ycbcr" in row]
    charts = {"curves": _curves_chart(curves)} if curves else {}
    return fr.Section([fr.table("Pictures", ("file", "caption"), lines)], charts)


# ---------------------------------------------------------------------------------------------
#  Curves
# ---------------------------------------------------------------------------------------------


def _curves(task: Task) -> list[Row]:
    """Measure PSNR over iterations of every method: the paper's figure of curves."""
    present = [name for name in CURVES if is_present(task, name)]
    return task.measure("pictures", [job for name in present for job in _curve_jobs(task, name)])


def _curve_jobs(task: Task, name: str) -> Iterator[Job]:
    model = eg.EigenGS.load("natural", task.backend)
    if name not in ("kodak", "samples"):
        model = model_for(task, name, name, COMPONENTS)
    shapes = model.gaussians
    marks = sorted({*range(0, task.iterations + 1, EVERY), task.iterations})

    def work(image: Image, preset: str) -> Row:
        method = METHODS[preset]
        start = model if method.needs_model else None
        options: Row = {"gaussians": len(shapes), "method": method, "start": start}
        moments = descent(image, task.iterations, marks, backend=task.backend, **options)
        return {"psnr_ycbcr": [eg.psnr(m.picture, image, "ycbcr") for m in moments], "marks": marks}

    for file, image in images_of(task, name):
        fitted = center_crop(image, shapes.width, shapes.height)
        for preset in PRESETS:
            label = {"set": name, "image": file, "preset": preset, "iterations": task.iterations}
            yield label, partial(work, fitted, preset)


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
        for preset in PRESETS:
            job = {"set": name, "preset": preset}
            some = [row for row in rows if job.items() <= row["job"].items()]
            marks: list[int] = max((row["marks"] for row in some), key=len, default=[])
            # A fit that has failed is None in a file, and NaN here.
            curves = [row["psnr_ycbcr"] for row in some if row["marks"] == marks]
            means = np.mean(np.array(curves, float), axis=0) if marks else []
            axis.plot(marks, means, label=preset, color=fr.COLORS[preset])
        fr.label_axes(axis, "iterations", "PSNR in YCbCr / dB", "", False, title=name)
    fr.legend_below(figure, axes[0], len(PRESETS))
    return figure


# ---------------------------------------------------------------------------------------------
#  Tiles
# ---------------------------------------------------------------------------------------------


def _tiles(task: Task) -> list[Row]:
    """Draw the middle of a slow gradient by every method, where Gaussians show as round tiles."""
    caption = f"The middle of a slow gradient after {task.iterations:,} steps; PSNR in YCbCr"

    def work() -> Row:
        case = CASES["smooth"]._replace(iterations=task.iterations)
        image = case.image()
        middle = (slice(len(image) // 3, 2 * len(image) // 3),) * 2
        cells, errors = list[Cell](), list[Cell]()
        for preset in PRESETS:
            picture = fit_case(case, image, preset, task.backend).image
            reached = eg.psnr(picture, image, "ycbcr")
            cells.append((f"{preset}: {reached:.1f} dB", picture[middle]))
            errors.append(("", (0.5 + STRETCHED * (picture - image))[middle]))
        rows = [("", cells), (f"their errors times {STRETCHED}", errors)]
        fr.save_figure(task.folder / TILES, strip(rows))
        return {"file": TILES, "caption": caption}

    return task.measure("pictures", [({"file": TILES, "iterations": task.iterations}, work)])


def strip(rows: Sequence[tuple[str, Sequence[Cell]]]) -> Figure:
    """Stack rows of pictures, each below its heading."""
    columns = max(len(cells) for _, cells in rows)
    figure = fr.new_figure(CELL * columns, (CELL + LETTERS) * len(rows))
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

"""The paper's curves with our fits.

A row has "psnr_ycbcr" after the steps in "marks", of a fit with the size of the model and its
number of Gaussians.
"""

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from matplotlib.figure import Figure

import eigengs_dr as eg
from eigengs_bench import report as fr
from eigengs_bench.clock import METHODS, Image, trace_of
from eigengs_bench.images import images_of, is_present, model_for
from eigengs_bench.rows import Job, Row, Task
from eigengs_dr.image.resize import center_crop

COMPONENTS = 300  # per channel of the models that are trained, as in the paper's comparisons
PRESETS = ("gaussianimage", "eigengs", "default")
CURVES = ("faces256", "cats256", "cars256", "natural256", "kodak", "samples")
EVERY = 100  # iterations between two points of a curve


def run(task: Task) -> list[Row]:
    """Measure PSNR over iterations of every method: the paper's figure of curves."""
    present = [name for name in CURVES if is_present(task, name)]
    return task.measure("pictures", [job for name in present for job in _jobs(task, name)])


def summarize(rows: Sequence[Row]) -> fr.Section:
    """List the PSNRs at the ends of the curves, and draw them."""
    ends = fr.frame_of(rows)
    ends["psnr_ycbcr"] = ends.psnr_ycbcr.str[-1].astype(float)
    cells = {"steps": ("iterations", "max"), "psnr_ycbcr": ("psnr_ycbcr", fr.mean)}
    table = fr.grouped("Means at the ends of the curves", ends, ["set", "preset"], cells)
    return fr.Section([table], {"curves": _chart(rows)})


def _jobs(task: Task, name: str) -> Iterator[Job]:
    model = eg.EigenGS.load("natural", task.backend)
    if name not in ("kodak", "samples"):
        model = model_for(task, name, name, COMPONENTS)
    shapes = model.gaussians
    marks = sorted({*range(0, task.iterations + 1, EVERY), task.iterations})

    def work(image: Image, preset: str) -> Row:
        method = METHODS[preset]
        start = model if method.needs_model else None
        options: Row = {"gaussians": len(shapes), "method": method, "start": start}
        rows = trace_of(image, task.iterations, marks, backend=task.backend, **options)
        return {
            "psnr_ycbcr": [row["psnr_ycbcr"] for row in rows],
            "marks": [row["iteration"] for row in rows],
        }

    for file, image in images_of(task, name):
        fitted = center_crop(image, shapes.width, shapes.height)
        for preset in PRESETS:
            label = {"set": name, "image": file, "preset": preset, "iterations": task.iterations}
            yield label, partial(work, fitted, preset)


def _chart(rows: Sequence[Row]) -> Figure:
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

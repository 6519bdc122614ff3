"""The paper's curves with our fits, and tiles side by side.

Curves have the size of the model, 256x256 pixels, and its number of Gaussians. The row of a curve
has "psnr_ycbcr" every `EVERY` steps; that of a picture says its file.
"""

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from matplotlib.figure import Figure
from PIL import Image as pillow

import eigengs_dr as eg
from eigengs_bench import report as fr
from eigengs_bench.cases import CASES
from eigengs_bench.clock import Image, descent
from eigengs_bench.images import images_of, is_trained, model_for
from eigengs_bench.names import PICTURES, PRESETS, SAMPLES
from eigengs_bench.rows import Job, Row, Task, code_name
from eigengs_bench.stability import moments, tiling
from eigengs_dr.image.io import to_8bit
from eigengs_dr.image.resize import center_crop, join_pictures, text_line
from eigengs_dr.storage.atomic import atomic_write

COMPONENTS = 300  # a channel of the models that are trained, as in the paper's comparisons
# Sets of the chart of PSNR, and their titles.
PANELS = {
    "faces256": "faces",
    "cats256": "cats",
    "cars256": "cars",
    "natural256": "ImageNet",
    "kodak": 'Kodak, basis "natural"',
    "samples": 'samples, basis "natural"',
}
EVERY = 50  # iterations between two points of a curve
STRETCHED = 20  # factor of errors before they are added to mid-grey
LETTERS = 13  # height of the letters below a picture, in pixels


def run(task: Task, wanted: Sequence[str]) -> list[Row]:
    """Measure curves of the sets that are there, and draw tiles into the folder."""
    jobs: list[Job] = []
    if "curves" in (wanted or PICTURES):
        kodak = task.data is not None and (task.data / "kodak").is_dir()
        present = [n for n in PANELS if is_trained(task, n) or (n == "kodak" and kodak)]
        jobs += [job for name in present or [SAMPLES] for job in _curves(task, name)]
    if "tiles" in (wanted or PICTURES):
        jobs.append(({"file": "tiles.png", "iterations": task.iterations}, partial(_tiles, task)))
    return task.measure("pictures", jobs)


def _curves(task: Task, name: str) -> Iterator[Job]:
    """Measure PSNR over iterations of every preset; "eigengs" starts from a model."""
    model = eg.EigenGS.load("natural", task.backend)
    if name not in ("kodak", "samples"):
        model = model_for(task, name, name, COMPONENTS)
    shapes = model.gaussians
    marks = sorted({*range(0, task.iterations + 1, EVERY), task.iterations})

    def work(image: Image, preset: str) -> Row:
        start, count = model if preset == "eigengs" else None, len(shapes)
        options = {"gaussians": count, "backend": task.backend, "preset": preset, "start": start}
        found = descent(image, task.iterations, marks, **options)
        return {"psnr_ycbcr": [eg.psnr(m.picture, image, "ycbcr") for m in found], "marks": marks}

    for file, image in images_of(task, name):
        for preset in PRESETS:
            label = {"set": name, "image": file, "preset": preset, "iterations": task.iterations}
            yield label, partial(work, center_crop(image, shapes.width, shapes.height), preset)


def _tiles(task: Task) -> Row:
    """Show the middle of a slow gradient by every preset, where Gaussians show as round tiles."""
    case = CASES["smooth"]._replace(iterations=task.iterations)
    image = case.image()
    middle = (slice(len(image) // 3, 2 * len(image) // 3),) * 2
    columns = []
    for preset in PRESETS:
        picture = moments(case, image, preset, task.backend)[-1].picture
        error = 0.5 + STRETCHED * (picture - image)
        parts = [np.clip(part[middle], 0, 1) for part in (picture, error)]
        text = text_line(f"{preset}: {tiling(picture, image):.2f}", parts[0].shape[1], LETTERS)
        columns.append(join_pictures([parts[0], text, parts[1]], 0, 0))
    codes = to_8bit(join_pictures(columns, 1)).astype(np.uint8)
    with atomic_write(task.folder / "tiles.png") as temporary:  # small, of 256 colours
        pillow.fromarray(codes).quantize(256).save(temporary, optimize=True)
    return {
        "file": "tiles.png",
        "caption": f"The middle of a slow gradient after {task.iterations:,} steps, its tiling in "
        f"8-bit levels, and its errors times {STRETCHED}",
    }


def summarize(rows: Sequence[Row]) -> fr.Section:
    """List the pictures, and draw the curves."""
    lines = [(row["file"], row["caption"]) for row in rows if "file" in row]
    curves = [row for row in rows if "psnr_ycbcr" in row]
    codes = [code_name(row["run"]) for row in rows]
    charts = {"curves": _chart(curves)} if curves else {}
    return fr.Section([fr.table("Pictures", ("file", "caption"), lines, codes)], charts)


def _chart(rows: Sequence[Row]) -> Figure:
    """Draw lines in the colours of the presets, one panel a set: means over its images."""
    names = list(dict.fromkeys(row["job"]["set"] for row in rows))
    figure = fr.new_figure(2.8 * len(names) + 0.6, 3.2)
    axes = figure.subplots(1, len(names), squeeze=False, sharey=True)[0]
    for axis, name in zip(axes, names, strict=True):
        for preset in PRESETS:
            job = {"set": name, "preset": preset}
            some = [row for row in rows if job.items() <= row["job"].items()]
            # A fit that has failed is None in a file, and NaN here.
            means = np.mean(np.array([row["psnr_ycbcr"] for row in some], float), axis=0)
            axis.plot(some[0]["marks"], means, label=preset, color=fr.COLORS[preset])
        title = PANELS[name]
        fr.label_axes(axis, "iterations", "PSNR (YCbCr) / dB", "", axis is axes[0], title=title)
    return figure

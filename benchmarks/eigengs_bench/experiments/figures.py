"""The pictures of the paper: what they need, and the list of them."""

import json
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eigengs_bench.experiments import figure_strips as strips
from eigengs_bench.experiments.figure_strips import METHODS, Figure, is_present, to_size
from eigengs_bench.harness.datasets import images_of, model_for
from eigengs_bench.harness.store import Job, Row, Task, code_name, today
from eigengs_bench.harness.timing import Image
from eigengs_bench.names import CATS, FIGURES, NATURAL
from eigengs_bench.report.charts import curves_chart, radii_chart, save_figure
from eigengs_bench.report.frames import remark
from eigengs_dr.cli.outputs import write_report
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.image.metrics import psnr

LIST, FILE = "figures.json", "curves.jsonl"

# Sets of the chart of PSNR, and their titles.
PANELS = {
    "faces256": "faces",
    "cats256": "cats",
    "cars256": "cars",
    "natural256": "ImageNet",
    "kodak": 'Kodak, basis "natural"',
}
EVERY = 50  # iterations between two points of a curve


def run(
    task: Task, names: Collection[str] = (), note: Callable[[str], None] = lambda text: None
) -> list[Figure]:
    """Draw figures into a folder, by default all, and list them in its ``figures.json``.

    `note` takes one line on figures that are left out because their image sets are not there.
    `ValueError` if nothing can be drawn.
    """
    listed = read_list(task.folder / LIST)  # a damaged list is an error now, not after minutes
    makers = strips.iterations, strips.colors, curves, radii, strips.split, strips.cross
    studies = dict(zip(FIGURES, makers, strict=True))
    wanted = [name for name in FIGURES if not names or name in names]
    drawn = [name for name in wanted if _has_sets(task, name)]
    if left := [name for name in wanted if name not in drawn]:
        where = f"no such sets in {task.data}" if task.data else "no folder DATA was named"
        note(f"left out: {', '.join(left)}: {where}")
    if not drawn:
        raise ValueError("no figure can be drawn without image sets; --figure colors needs none")
    made = [figure for name in drawn for figure in studies[name](task)]
    fresh = [{**figure._asdict(), "run": {"date": today(), **task.run}} for figure in made]
    entries = [entry for entry in listed if entry["name"] not in drawn] + fresh
    entries.sort(key=lambda entry: FIGURES.index(entry["name"]))
    write_report(task.folder / LIST, {"figures": entries})
    return made


def _has_sets(task: Task, name: str) -> bool:
    if name == "curves":
        return any(is_present(task, panel) for panel in PANELS)
    needed = {"radii": [CATS], "split": [CATS], "cross": [CATS, NATURAL]}.get(name, [])
    return all(is_present(task, used) for used in needed)


def read_list(path: Path) -> list[Row]:
    """Read the listed figures, each with its "run"; `ValueError` if the file is damaged."""
    if not path.exists():
        return []
    try:
        found = json.loads(path.read_text(encoding="utf-8"))["figures"]
        return [{key: figure[key] for key in (*Figure._fields, "run")} for figure in found]
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{path}: is damaged; delete it, and draw the figures again") from None


def curves(task: Task) -> Iterator[Figure]:
    """Draw PSNR over iterations of every preset: the paper's figure of curves."""
    marks = sorted({*range(0, task.iterations + 1, EVERY), task.iterations})
    panels, rows = dict[str, dict[str, list[float]]](), list[Row]()
    for name in (name for name in PANELS if is_present(task, name)):
        measured = task.measure(FILE, _curve_jobs(task, name, marks), f"curves of {name}")
        rows += measured
        panels[PANELS[name]] = {
            preset: _mean([row for row in measured if row["job"]["preset"] == preset])
            for preset in METHODS
        }
    chart = curves_chart(panels, marks, "iterations", "PSNR (YCbCr) / dB")
    save_figure(task.folder / "curves.svg", chart)
    caption = (
        f"PSNR in YCbCr every {EVERY} iterations, mean of up to {task.images} test images a set. "
        "eigengs starts from a basis of each set's own training images, for Kodak from the one "
        f"that ships.{remark(code_name(row['run']) for row in rows)}"
    )
    yield Figure("curves", "curves.svg", caption)


def _curve_jobs(task: Task, name: str, marks: Sequence[int]) -> Iterator[Job]:
    settings = {"iterations": task.iterations, "every": EVERY, "seed": task.seed}
    if name == "kodak":
        model = EigenGS.load("natural", task.backend)
    else:
        model = model_for(task, name, name, strips.COMPONENTS)
    for file, image in images_of(task, name):
        for preset in METHODS:
            label = {"set": name, "image": file, "preset": preset, **settings}
            yield label, partial(_curve, task, to_size(image, model), model, preset, marks)


def _curve(task: Task, image: Image, model: EigenGS, preset: str, marks: Sequence[int]) -> Row:
    moments = strips.preset_descent(task, image, model, preset, marks)
    return {"psnr_ycbcr": [psnr(moment.picture, image, "ycbcr") for moment in moments]}


def _mean(measured: list[Row]) -> list[float]:
    # A fit that has failed is None in a file, and NaN here.
    return list(np.mean(np.array([row["psnr_ycbcr"] for row in measured], float), axis=0))


def radii(task: Task) -> Iterator[Figure]:
    """Draw how large Gaussians are, with and without the split by frequency, as in the paper."""
    images, panels = images_of(task, CATS), {}
    for whole, title in ((False, "no split"), (True, "frequency-aware split")):
        model = model_for(task, CATS, CATS, strips.COMPONENTS, split=whole)
        found = []
        for done, (_, image) in enumerate(images):
            task.progress(f"radii, {title}", done, len(images))
            *_, last = strips.preset_descent(task, image, model, "eigengs", [task.iterations])
            found.append(radii_of(last.gaussians))
        panels[title] = np.split(np.stack(found), [model.low], axis=1)
    save_figure(task.folder / "radii.svg", radii_chart(panels))
    caption = (
        "Radii of the Gaussians (geometric mean of the two standard deviations) after "
        f'{task.iterations:,} iterations of the preset "eigengs", mean of {len(images)} cats. '
        "Right, a tenth of the Gaussians serve the first 50 components."
    )
    yield Figure("radii", "radii.svg", caption)


def radii_of(gaussians: Gaussians) -> NDArray[np.float64]:
    """Geometric mean of the standard deviations of every Gaussian, in pixels, shape (N,)."""
    factor = gaussians.to_arrays()["factor"].astype(np.float64)
    return 1 / np.sqrt(factor[:, 0] * factor[:, 2])  # det F = a c

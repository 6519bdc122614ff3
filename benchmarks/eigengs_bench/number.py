"""The fewest Gaussians for a PSNR, as the search finds them.

A row has gaussians, stopped, iterations, seconds, psnr_ycbcr and psnr_rgb of a search, and
fit_seconds and fit_psnr of a default fit of as many Gaussians.
"""

from collections.abc import Iterator, Sequence
from functools import partial

import eigengs_dr as eg
from eigengs_bench import report as fr
from eigengs_bench.clock import Image, decibels, warm_up
from eigengs_bench.images import images_of
from eigengs_bench.rows import Job, Row, Task


def run(task: Task, names: Sequence[str], targets: Sequence[float]) -> list[Row]:
    """Search for the number of Gaussians for every target, on every image of some sets."""
    return task.measure("number", list(_jobs(task, names, targets)))


def _jobs(task: Task, names: Sequence[str], targets: Sequence[float]) -> Iterator[Job]:
    for name in names:
        for file, image in images_of(task, name):
            for target in targets:
                job = {"set": name, "image": file, "iterations": task.iterations}
                yield {**job, "target": float(target)}, partial(_search, task, image, target)


def _search(task: Task, image: Image, target: float) -> Row:
    goal = eg.Goal(target, space="ycbcr")
    search = partial(eg.fit, image, target_psnr=goal, backend=task.backend)
    warm_up(image, task.iterations, target_psnr=goal, backend=task.backend)
    result = search(iterations=task.iterations)
    count = len(result.gaussians)
    usual = eg.fit(image, count, task.iterations, backend=task.backend)
    return {
        "gaussians": count,
        **{key: getattr(result, key) for key in ("stopped", "iterations", "seconds")},
        **{f"psnr_{space}": decibels(result.image, image, space) for space in ("ycbcr", "rgb")},
        "fit_seconds": usual.seconds,
        "fit_psnr": decibels(usual.image, image, "ycbcr"),
    }


COLUMNS = {
    "Gaussians": ("gaussians", partial(fr.median, decimals=0)),
    "of all images": ("gaussians", partial(fr.extent, decimals=0)),
    "% met": ("met", lambda values: f"{100 * values.mean():.0f}"),
    "s": ("seconds", fr.median),
    "over a fit": ("ratio", fr.median),
    "fit, dB": ("fit_psnr", fr.median),
}


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out how many Gaussians a PSNR takes: a table per set."""
    tables, points = [], fr.frame_of(rows)
    points["met"] = points.stopped == "met"
    points["ratio"] = points.seconds / points.fit_seconds
    points["PSNR"] = points.target.map("{:g} dB".format)
    for name, part in points.groupby("set", sort=False):
        caption = (
            f"{name}, {fr.counted(part.image)}: Gaussians that the search finds for a PSNR in "
            "YCbCr, median and range; its seconds, also over those of a default fit of as many "
            "Gaussians, and the PSNR of this fit"
        )
        tables.append(fr.grouped(caption, part, ["PSNR"], COLUMNS)._replace(name=str(name)))
    return fr.Section(tables)

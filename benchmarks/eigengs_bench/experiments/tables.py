"""The paper's tables on sets of images: every method on every image, step by step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from typing import NamedTuple

from eigengs_bench.harness.datasets import has_training_images, images_of, model_for
from eigengs_bench.harness.store import Job, Row
from eigengs_bench.harness.task import Task
from eigengs_bench.harness.timing import Image, follow, score, warm_up
from eigengs_bench.names import NATURAL, SETS, TABLES
from eigengs_dr.descent import LONG
from eigengs_dr.eigengs import EigenGS
from eigengs_dr.metrics import psnr
from eigengs_dr.presets import PRESETS
from eigengs_dr.starting import Start, begin

FILE = "tables.jsonl"

ITERATIONS = (0, 10, 100, 500, 1000, 5000, 10000)
"""Where the paper's tables look, and 0 and 10 beside."""

COMPONENTS = (300, 500)
"""Components a channel in the paper's tables."""

LENT = {"faces256": "cats256", "cats256": "faces256"}
"""The sets that lend each other their basis."""

SOLVE_STEPS = (1, 2, 3, 5, 10)
"""Depths of the colour solve that are tried for the earliest start that is good enough."""


class Method(NamedTuple):
    """One method; the fields are part of a measurement's name.

    Attributes
    ----------
    preset : str
    source : str
        The set whose training images the basis is of; "" without a basis.
    components : int
        Of each channel.
    color : str
    split : str
        "auto", "split" or "whole": `frequency_aware` of `EigenGS.fit`.
    """

    preset: str
    source: str = ""
    components: int = 0
    color: str = "ycbcr"
    split: str = "auto"


def methods(name: str, table: str, sources: Sequence[str]) -> list[Method]:
    """List the methods that a table compares on a set.

    Parameters
    ----------
    name : str
        One of `SETS`.
    table : str
        One of `TABLES`.
    sources : sequence of str
        Sets that have images to train on.
    """
    own = [name] if name in sources else []
    if table == "ablation":
        return [
            Method("eigengs", name, COMPONENTS[0], color, split)
            for _ in own
            for color in ("ycbcr", "rgb")
            for split in ("split", "whole")
        ]
    lent = [LENT[name]] if LENT.get(name) in sources else []
    if NATURAL in sources and name != NATURAL:
        lent.append(NATURAL)
    if table == "cross":
        plain = [Method("gaussianimage")] if lent else []
        return plain + [Method("eigengs", source, COMPONENTS[0]) for source in lent]
    universal = [source for source in lent if source == NATURAL]
    bases = [Method("eigengs", s, count) for s in own + universal for count in COMPONENTS]
    return [Method("gaussianimage"), Method("default"), *(bases if table == "main" else [])]


def run(task: Task, names: Sequence[str], tables: Sequence[str] = TABLES) -> list[Row]:
    """Measure what tables need, image by image, its methods in turn.

    Parameters
    ----------
    task : Task
        Fits are looked at after those of `ITERATIONS` up to its number of steps, and at the end.
    names, tables : sequence of str
        Of `SETS` and `TABLES`.

    Returns
    -------
    list of dict
        A row has "job" with set, image, seed, iterations and the fields of `Method`, and
        "moments", see `score`; or, for "reach", the figures of `_reach`.

    Raises
    ------
    ImageError
        If a set has no images.
    """
    found = []
    sources = [name for name in SETS if has_training_images(task.data, name)]
    for name in names:
        compared = list(dict.fromkeys(m for table in tables for m in methods(name, table, sources)))
        pictures = images_of(task, name)
        ready = _preparation(task, name, pictures[0][1])
        measured = task.measure(FILE, _jobs(task, name, pictures, compared, ready), name)
        found += measured
        if "reach" in tables:
            goals = {
                row["job"]["image"]: row["moments"][-1]
                for row in measured
                if row["job"]["preset"] == "gaussianimage"
            }
            found += task.measure(FILE, _reach_jobs(task, name, pictures, goals, ready), name)
    return found


Ready = Callable[[Method], Callable[..., Start]]


def _preparation(task: Task, name: str, picture: Image) -> Ready:
    """Function that returns how a method starts; asked first, it trains and compiles untimed."""

    @cache
    def ready(method: Method) -> Callable[..., Start]:
        model: EigenGS | str = "natural"
        if method.source:
            split = {"split": True, "whole": False}.get(method.split, "auto")
            model = model_for(task, name, method.source, method.components, method.color, split)
        preset = PRESETS[method.preset]
        count = None if method.source else SETS[name].gaussians

        def start(image: Image, seed: int, depth: int = 10) -> Start:
            settings = (count, "auto", model, preset, depth, method.color, seed)
            return begin(image, *settings, backend=task.backend)

        warm_up(lambda: start(picture, 0), preset.schedule, LONG)
        return start

    return ready


def _name(task: Task, name: str, image: str) -> Row:
    shared = {"set": name, "iterations": task.iterations, "seed": task.seed}
    return {**shared, "image": image, "gaussians": SETS[name].gaussians}


def _jobs(
    task: Task,
    name: str,
    pictures: Sequence[tuple[str, Image]],
    compared: Sequence[Method],
    ready: Ready,
) -> Iterator[Job]:
    marks = {mark for mark in ITERATIONS if mark < task.iterations} | {task.iterations}

    def work(method: Method, image: Image) -> Row:
        start, schedule = ready(method), PRESETS[method.preset].schedule
        moments = follow(lambda: start(image, task.seed), schedule, task.iterations, marks)
        return {"moments": [score(moment, image) for moment in moments]}

    for file, image in pictures:
        for method in compared:
            yield {**_name(task, name, file), **method._asdict()}, partial(work, method, image)


def _reach_jobs(
    task: Task,
    name: str,
    pictures: Sequence[tuple[str, Image]],
    goals: dict[str, Row],
    ready: Ready,
) -> Iterator[Job]:
    def work(image: Image, goal: Row) -> Row:
        start = ready(Method("default"))
        return _reach(lambda depth: start(image, task.seed, depth), image, goal)

    for file, image in pictures:
        label = {**_name(task, name, file), "reach": "gaussianimage"}
        yield label, partial(work, image, goals[file])


def _reach(start: Callable[[int], Start], image: Image, goal: Row) -> Row:
    """Time until "default" has the PSNR of a goal: by its start, stopped early, or after it.

    Returns `solve_steps` and `iteration` where that was, `seconds`, `psnr_ycbcr`, and as `share`
    the seconds over those of the goal.
    """
    schedule = PRESETS["default"].schedule
    for depth in SOLVE_STEPS:
        steps = 1000 if depth == SOLVE_STEPS[-1] else 0
        for moment in follow(partial(start, depth), schedule, steps, range(steps + 1)):
            reached = psnr(moment.picture, image, "ycbcr")
            if reached >= goal["psnr_ycbcr"]:
                return {
                    "solve_steps": depth,
                    "iteration": moment.iteration,
                    "seconds": moment.seconds,
                    "psnr_ycbcr": reached,
                    "share": moment.seconds / goal["seconds"],
                }
    return {"share": None}

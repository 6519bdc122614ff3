"""The paper's tables on sets of images: every method on every image, step by step.

A row has "job" with set, image, seed, iterations, gaussians and the fields of `Method`, and
"moments", a list of `score`. A row of the table "reach" has the figures of `_reach`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

from eigengs_bench.harness.datasets import images_of, is_trained, model_for
from eigengs_bench.harness.store import Job, Row, Task
from eigengs_bench.harness.timing import Image, follow, score, warm_up
from eigengs_bench.names import NATURAL, SETS, TABLES
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.fitting.descent import FitProblem
from eigengs_dr.fitting.options import PRESETS, FitOptions
from eigengs_dr.fitting.schedule import MIN_PHASE_RATIO
from eigengs_dr.fitting.start import initialize, mean_picture
from eigengs_dr.image.metrics import psnr

FILE = "tables.jsonl"

# Where the paper's tables look, and 0 and 10 beside.
ITERATIONS = (0, 10, 100, 500, 1000, 5000, 10000)
COMPONENTS = (300, 500)  # components a channel in the paper's tables
LENT = {"faces256": "cats256", "cats256": "faces256"}  # the sets that lend each other their basis
# Depths of the colour solve that are tried for the earliest start that is good enough.
SOLVE_STEPS = (1, 2, 3, 5, 10)


class Method(NamedTuple):
    """A preset, and the model it starts from: of the training images of `source`, "" for none."""

    preset: str
    source: str = ""
    components: int = 0
    space: str = "ycbcr"
    split: str = "auto"  # or "split" or "whole": frequency_aware of EigenGS.fit


Ready = Callable[[Method], tuple[Callable[..., FitProblem], Image | None]]
Pictures = Sequence[tuple[str, Image]]


def methods(name: str, table: str, sources: Sequence[str]) -> list[Method]:
    """List the methods that a table compares on a set; `sources` are the sets with a basis."""
    own = [name] if name in sources else []
    lent = [LENT[name]] if LENT.get(name) in sources else []
    universal = [NATURAL] if NATURAL in sources and name != NATURAL else []
    plain, count = [Method("gaussianimage")], COMPONENTS[0]
    if table == "ablation":
        pairs = [(color, split) for color in ("ycbcr", "rgb") for split in ("split", "whole")]
        return [Method("eigengs", name, count, *pair) for _ in own for pair in pairs]
    if table == "cross":
        others = [Method("eigengs", source, count) for source in lent + universal]
        return plain + others if others else []
    bases = [Method("eigengs", source, k) for source in own + universal for k in COMPONENTS]
    return [*plain, Method("default"), *(bases if table == "main" else [])]


def run(task: Task, names: Sequence[str], tables: Sequence[str] = TABLES) -> list[Row]:
    """Measure what tables need on sets, image by image, the methods in turn."""
    found, sources = list[Row](), [name for name in SETS if is_trained(task.data, name)]
    for name in names:
        compared = list(dict.fromkeys(m for table in tables for m in methods(name, table, sources)))
        pictures = images_of(task, name)
        ready = _preparation(task, name, pictures[0][1])
        measured = task.measure(FILE, _jobs(task, name, pictures, compared, ready), name)
        found += measured
        if "reach" in tables:
            plain = [row for row in measured if row["job"]["preset"] == "gaussianimage"]
            goals = {row["job"]["image"]: row["moments"][-1] for row in plain}
            found += task.measure(FILE, _reach_jobs(task, name, pictures, goals, ready), name)
    return found


def _preparation(task: Task, name: str, picture: Image) -> Ready:
    """Function that returns how a method starts, and the mean image that it keeps as pixels.

    Its first call trains and compiles, untimed.
    """

    @cache
    def ready(method: Method) -> tuple[Callable[..., FitProblem], Image | None]:
        model: EigenGS | None = None
        if method.source:
            split = {"split": True, "whole": False}.get(method.split, "auto")
            model = model_for(task, name, method.source, method.components, method.space, split)
        count = None if method.source else SETS[name].gaussians
        chosen: Any = {"preset": method.preset, "space": method.space, "backend": task.backend}
        options = FitOptions(gaussians=count, start=model, **chosen)

        def start(image: Image, seed: int, depth: int = 10) -> FitProblem:
            return initialize(image, replace(options, seed=seed, solve_steps=depth))

        warm_up(lambda: start(picture, 0), options.method.schedule, MIN_PHASE_RATIO)
        return start, mean_picture(options, picture.shape[1], picture.shape[0])

    return ready


def _name(task: Task, name: str, image: str) -> Row:
    shared = {"set": name, "iterations": task.iterations, "seed": task.seed}
    return {**shared, "image": image, "gaussians": SETS[name].gaussians}


def _jobs(
    task: Task, name: str, pictures: Pictures, compared: Sequence[Method], ready: Ready
) -> Iterator[Job]:
    marks = {mark for mark in ITERATIONS if mark < task.iterations} | {task.iterations}

    def work(method: Method, image: Image) -> Row:
        (start, mean_image), schedule = ready(method), PRESETS[method.preset].schedule
        begin = partial(start, image, task.seed)
        moments = follow(begin, schedule, task.iterations, marks, mean_image)
        return {"moments": [score(moment, image) for moment in moments]}

    for file, image in pictures:
        for method in compared:
            yield {**_name(task, name, file), **method._asdict()}, partial(work, method, image)


def _reach_jobs(
    task: Task, name: str, pictures: Pictures, goals: dict[str, Row], ready: Ready
) -> Iterator[Job]:
    def work(image: Image, goal: Row) -> Row:
        return _reach(partial(ready(Method("default"))[0], image, task.seed), image, goal)

    for file, image in pictures:
        label = {**_name(task, name, file), "reach": "gaussianimage"}
        yield label, partial(work, image, goals[file])


def _reach(start: Callable[[int], FitProblem], image: Image, goal: Row) -> Row:
    """Time until "default" has the PSNR of a goal: by its start, stopped early, or after it.

    "share" is that time over the time of the goal; None alone where it is never reached.
    """
    schedule = PRESETS["default"].schedule
    for depth in SOLVE_STEPS:
        steps = 1000 if depth == SOLVE_STEPS[-1] else 0
        for moment in follow(partial(start, depth), schedule, steps, range(steps + 1)):
            reached = psnr(moment.picture, image, "ycbcr")
            if reached >= goal["psnr_ycbcr"]:
                where = {"solve_steps": depth, "iteration": moment.iteration}
                share = moment.seconds / goal["seconds"]
                return {**where, "seconds": moment.seconds, "psnr_ycbcr": reached, "share": share}
    return {"share": None}

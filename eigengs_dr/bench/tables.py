"""The paper's tables on sets of images: every method on every image, step by step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from ..eigenbasis.eigengs import EigenGS
from ..fitting.initializers import FitProblem, initialize
from ..fitting.optimizers.schedule import MIN_PHASE_RATIO
from ..fitting.presets import PRESETS
from ..image.metrics import psnr
from . import rows
from .rows import Job, Row
from .sets import SETS, UNIVERSAL, Image, ImageSet, model_for, test_images
from .trial import ITERATIONS, follow, judged, warm_up

TABLES = ("main", "ablation", "cross", "reach")
"""What is measured: the methods; colour spaces and the split; bases of other sets; and how soon
"default" has what "gaussianimage" has at the end."""

PAPERS_COMPONENTS = (300, 500)
"""Components a channel in the paper's tables."""

OTHERS = {"faces256": "cats256", "cats256": "faces256"}
"""The sets that lend each other their basis."""

SOLVE_STEPS = (1, 2, 3, 5, 10)
"""Depths of the colour solve that are tried for the earliest start that is good enough."""

Progress = Callable[[str, int, int], None]


class Method(NamedTuple):
    """What is compared; the fields are part of a measurement's name.

    Attributes
    ----------
    preset : str
    source : str
        The set whose training images the basis is of; "" without a basis.
    components : int
        A channel.
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
            Method("eigengs", name, PAPERS_COMPONENTS[0], color, split)
            for _ in own
            for color in ("ycbcr", "rgb")
            for split in ("split", "whole")
        ]
    lent = [OTHERS[name]] if OTHERS.get(name) in sources else []
    if UNIVERSAL in sources and name != UNIVERSAL:
        lent.append(UNIVERSAL)
    if table == "cross":
        plain = [Method("gaussianimage")] if lent else []
        return plain + [Method("eigengs", source, PAPERS_COMPONENTS[0]) for source in lent]
    universal = [source for source in lent if source == UNIVERSAL]
    bases = [
        Method("eigengs", source, components)
        for source in own + universal
        for components in PAPERS_COMPONENTS
    ]
    return [Method("gaussianimage"), Method("default"), *(bases if table == "main" else [])]


def run(
    data: Path,
    folder: Path,
    names: Sequence[str],
    tables: Sequence[str],
    images: int,
    iterations: int,
    seed: int,
    about: Row,
    backend: str | None = None,
    progress: Progress = lambda label, done, total: None,
) -> list[Row]:
    """Measure what tables need, image by image, its methods in turn.

    Parameters
    ----------
    data : Path
        See `sets`.
    folder : Path
        Where ``tables.jsonl`` is continued and models are kept.
    names, tables : sequence of str
        Of `SETS` and `TABLES`.
    images : int
        How many of a set, at most.
    iterations : int
        Steps of every run; those of `ITERATIONS` up to it are looked at, and the last.
    seed : int
    about : dict
        What lines say of their run, see `rows.measure`.
    backend : {"llvm", "cuda"}, optional
    progress : callable, optional
        ``progress(label, done, total)``.

    Returns
    -------
    list of dict
        A row has "job" with set, image, seed, iterations and the fields of `Method`, and
        "moments", see `trial.judged`; or, for "reach", those of `_reach`.

    Raises
    ------
    ImageError
        If a set has no images.
    """
    found = []
    sources = [name for name in SETS if (data / SETS[name].folder / "train").is_dir()]
    for name in names:
        compared = list(dict.fromkeys(m for table in tables for m in methods(name, table, sources)))
        pictures = test_images(data, name, images)
        ready = _preparation(data, folder / "models", name, pictures[0][1], backend, progress)
        shared = {"set": name, "iterations": iterations, "seed": seed}
        jobs = _jobs(pictures, compared, SETS[name], shared, ready)

        def show(done: int, total: int, name: str = name) -> None:
            progress(name, done, total)

        measured = rows.measure(folder / "tables.jsonl", jobs, about, show)
        found += measured
        if "reach" in tables:
            goals = _goals(measured)
            jobs = _reach_jobs(pictures, goals, SETS[name], shared, ready)
            found += rows.measure(folder / "tables.jsonl", jobs, about, show)
    return found


Ready = Callable[[Method], Callable[..., FitProblem]]


def _preparation(
    data: Path,
    models: Path,
    name: str,
    picture: Image,
    backend: str | None,
    progress: Progress,
) -> Ready:
    """Function that returns how a method starts; asked first, it trains and compiles untimed."""

    @cache
    def ready(method: Method) -> Callable[..., FitProblem]:
        model: EigenGS | str = "natural"
        if method.source:
            split = {"split": True, "whole": False}.get(method.split, "auto")
            model = model_for(
                data,
                name,
                method.source,
                method.components,
                models,
                method.color,
                split,
                progress,
                backend,
            )

        def start(image: Image, seed: int, solve_steps: int = 10) -> FitProblem:
            preset = PRESETS[method.preset]
            count = None if method.source else SETS[name].gaussians
            return initialize(
                image,
                count,
                "auto",
                model,
                preset,
                solve_steps,
                method.color,
                seed,
                backend=backend,
            )

        warm_up(lambda: start(picture, 0), PRESETS[method.preset].schedule, MIN_PHASE_RATIO)
        return start

    return ready


def _jobs(
    pictures: Sequence[tuple[str, Image]],
    compared: Sequence[Method],
    chosen: ImageSet,
    shared: Row,
    ready: Ready,
) -> Iterator[Job]:
    for file, image in pictures:
        for method in compared:
            name = {**shared, "image": file, "gaussians": chosen.gaussians, **method._asdict()}

            def work(method: Method = method, image: Image = image) -> Row:
                start = ready(method)
                iterations = shared["iterations"]
                moments = follow(
                    lambda: start(image, shared["seed"]),
                    PRESETS[method.preset].schedule,
                    iterations,
                    {mark for mark in ITERATIONS if mark < iterations} | {iterations},
                )
                return {"moments": [judged(moment, image) for moment in moments]}

            yield name, work


def _goals(measured: Sequence[Row]) -> dict[str, Row]:
    """Last moment of "gaussianimage", by image."""
    return {
        row["job"]["image"]: row["moments"][-1]
        for row in measured
        if row["job"]["preset"] == "gaussianimage"
    }


def _reach_jobs(
    pictures: Sequence[tuple[str, Image]],
    goals: dict[str, Row],
    chosen: ImageSet,
    shared: Row,
    ready: Ready,
) -> Iterator[Job]:
    for file, image in pictures:
        name = {**shared, "image": file, "gaussians": chosen.gaussians, "reach": "gaussianimage"}

        def work(image: Image = image, goal: Row = goals[file]) -> Row:
            start = ready(Method("default"))
            return _reach(lambda depth: start(image, shared["seed"], depth), image, goal)

        yield name, work


def _reach(start: Callable[[int], FitProblem], image: Image, goal: dict[str, Any]) -> Row:
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

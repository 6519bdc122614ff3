"""The paper's tables on sets of images: every method on every image, step by step.

A row has "job" with set, image, iterations, gaussians and the fields of `Method`, and "moments", a
list of `score`. A row of the table "reach" has the figures of `_reach`.

Tai et al., "EigenGS Representation", CVPR 2025: tables 1 (FFHQ), 2 (transfer) and 3 (ablation).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import pandas as pd

import eigengs_dr as eg
from eigengs_bench import report as fr
from eigengs_bench.clock import Image, follow, score, warm_up
from eigengs_bench.images import images_of, is_trained, model_for
from eigengs_bench.names import NATURAL, SETS, TABLES
from eigengs_bench.rows import Job, Row, Task
from eigengs_dr.fitting.descent import FitProblem
from eigengs_dr.fitting.options import PRESETS, FitOptions
from eigengs_dr.fitting.schedule import MIN_PHASE_RATIO
from eigengs_dr.fitting.start import initialize, mean_picture

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
    found, sources = list[Row](), [name for name in SETS if is_trained(task, name)]
    for name in names:
        wanted = tables or TABLES
        compared = list(dict.fromkeys(m for table in wanted for m in methods(name, table, sources)))
        pictures = images_of(task, name)
        ready = _preparation(task, name, pictures[0][1])
        measured = task.measure("tables", _jobs(task, name, pictures, compared, ready), name)
        found += measured
        if "reach" in wanted:
            plain = [row for row in measured if row["job"]["preset"] == "gaussianimage"]
            goals = {row["job"]["image"]: row["moments"][-1] for row in plain}
            found += task.measure("tables", _reach_jobs(task, name, pictures, goals, ready), name)
    return found


def _preparation(task: Task, name: str, picture: Image) -> Ready:
    """Function that returns how a method starts, and the mean image that it keeps as pixels.

    Its first call trains and compiles, untimed.
    """

    @cache
    def ready(method: Method) -> tuple[Callable[..., FitProblem], Image | None]:
        model: eg.EigenGS | None = None
        if method.source:
            split = {"split": True, "whole": False}.get(method.split, "auto")
            model = model_for(task, name, method.source, method.components, method.space, split)
        count = None if method.source else SETS[name].gaussians
        chosen: Any = {"preset": method.preset, "space": method.space, "backend": task.backend}
        options = FitOptions(gaussians=count, start=model, **chosen)

        def start(image: Image, depth: int = 10) -> FitProblem:
            return initialize(image, replace(options, solve_steps=depth))

        warm_up(lambda: start(picture), options.method.schedule, MIN_PHASE_RATIO)
        return start, mean_picture(options, picture.shape[1], picture.shape[0])

    return ready


def _name(task: Task, name: str, image: str) -> Row:
    shared = {"set": name, "iterations": task.iterations, "gaussians": SETS[name].gaussians}
    return {**shared, "image": image}


def _jobs(
    task: Task, name: str, pictures: Pictures, compared: Sequence[Method], ready: Ready
) -> Iterator[Job]:
    marks = {mark for mark in ITERATIONS if mark < task.iterations} | {task.iterations}

    def work(method: Method, image: Image) -> Row:
        (start, mean_image), schedule = ready(method), PRESETS[method.preset].schedule
        moments = follow(partial(start, image), schedule, task.iterations, marks, mean_image)
        return {"moments": [score(moment, image) for moment in moments]}

    for file, image in pictures:
        for method in compared:
            yield {**_name(task, name, file), **method._asdict()}, partial(work, method, image)


def _reach_jobs(
    task: Task, name: str, pictures: Pictures, goals: dict[str, Row], ready: Ready
) -> Iterator[Job]:
    def work(image: Image, goal: Row) -> Row:
        return _reach(partial(ready(Method("default"))[0], image), image, goal)

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
            reached = eg.psnr(moment.picture, image, "ycbcr")
            if reached >= goal["psnr_ycbcr"]:
                where = {"solve_steps": depth, "iteration": moment.iteration}
                share = moment.seconds / goal["seconds"]
                return {**where, "seconds": moment.seconds, "psnr_ycbcr": reached, "share": share}
    return {"share": None}


# ---------------------------------------------------------------------------------------------
#  The tables, and the figures that the paper prints
# ---------------------------------------------------------------------------------------------

STEPS = ("images", "method", "0", "100", "500", "1,000", "5,000", "10,000")
PRINTED = [  # rows of tables 1 and 2
    ("FFHQ, 512x512", "GaussianImage", "-", "10.4", "21.8", "29.4", "39.2", "40.1"),
    ("FFHQ, 512x512", "EigenGS, 300", "28.0", "34.4", "36.4", "37.5", "40.7", "41.8"),
    ("FFHQ, 512x512", "EigenGS, 500", "28.9", "34.8", "36.7", "37.7", "40.8", "41.8"),
    ("CelebA, 256x256", "GaussianImage", "-", "10.3", "21.9", "30.0", "43.8", "45.2"),
    ("CelebA, 256x256", "of cats", "28.2", "36.2", "40.7", "43.2", "47.2", "48.2"),
    ("CelebA, 256x256", "of ImageNet", "28.7", "35.4", "39.6", "42.2", "46.3", "47.3"),
    ("Cats, 256x256", "of ImageNet", "29.6", "37.6", "41.1", "42.9", "45.9", "46.6"),
]
SPACES = ("fitted in", "split", "CelebA", "FFHQ", "Cats", "Cars")
ABLATION = [  # rows of table 3, after 10,000 steps
    ("ycbcr", "split", "47.2", "41.8", "45.7", "44.7"),
    ("ycbcr", "whole", "48.0", "40.7", "46.1", "43.5"),
    ("rgb", "split", "39.5", "34.9", "38.5", "36.4"),
    ("rgb", "whole", "39.9", "33.3", "38.9", "35.1"),
]
KINDS = {"main": "Methods", "cross": "Bases of other images", "ablation": "Colour space and split"}
ENDS: dict[str, Any] = {
    "RGB": ("psnr_rgb", fr.mean),
    "SSIM": ("ssim", partial(fr.mean, decimals=3)),
    "MS-SSIM": ("ms_ssim", partial(fr.mean, decimals=3)),
    "s": ("seconds", partial(fr.median, decimals=3)),
    "% above 35 dB": ("psnr_ycbcr", lambda values: fr.number(100 * (values > 35).mean(), 0)),
    "% above 40 dB": ("psnr_ycbcr", lambda values: fr.number(100 * (values > 40).mean(), 0)),
}
REACHES = {
    "images": ("share", lambda values: f"{values.count()} of {len(values)}"),
    "seconds": ("seconds", partial(fr.median, decimals=3)),
    "share of its time": ("share", partial(fr.median, decimals=4)),
    "largest share": ("share", lambda values: fr.number(values.max(), 4)),
}


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Make a table of each kind and number of steps, and those that the paper prints.

    A line is a set and a method: psnr_ycbcr by steps, means over the images, and figures of the
    last step. The last table says how soon "default" has what "gaussianimage" has at the end.
    """
    fits, tables = fr.frame_of(rows, "moments"), []
    for length in sorted(fits.iterations.unique()) if len(fits) else ():
        for kind, title in KINDS.items():
            chosen = _chosen(fits[fits.iterations == length], kind)
            if len(chosen) and chosen.method.nunique() > 1:
                tables.append(_by_steps(f"{title}, {length:,} steps", chosen))
    tables.append(fr.table("What the paper prints: PSNR / dB", STEPS, PRINTED))
    tables.append(fr.table("What the paper prints, after 10,000 steps", SPACES, ABLATION))
    if len(reached := fr.frame_of(row for row in rows if "share" in row)):
        reached["its steps"] = reached.iterations.map("{:,}".format)
        caption = "Time until default has the PSNR of gaussianimage at its last step"
        tables.append(fr.grouped(caption, reached, ["set", "its steps"], REACHES))
    return fr.Section(tables)


def _chosen(fits: pd.DataFrame, kind: str) -> pd.DataFrame:
    """Choose the fits of a kind of table, in the order of its methods, with a column "method"."""
    parts = []
    for name, some in fits.groupby("set", sort=False):
        labels = {m: label(m, str(name)) for m in methods(str(name), kind, list(SETS))}
        keys = some[list(Method._fields)].itertuples(index=False, name=None)
        some = some.assign(method=[labels.get(Method(*key)) for key in keys])
        order = list(labels.values())
        parts.append(
            some.dropna(subset="method").sort_values(
                "method", key=lambda values, order=order: values.map(order.index), kind="stable"
            )
        )
    return pd.concat(parts) if parts else fits


def label(method: Method, name: str) -> str:
    """Name of a method on a set, for a reader."""
    if not method.source:
        return method.preset
    basis = {NATURAL: "universal", name: "own"}.get(method.source, method.source)
    text = f"{method.preset}, {method.components} components, {basis} basis"
    return text if method.split == "auto" else f"{method.preset}, {method.space}, {method.split}"


def _by_steps(caption: str, fits: pd.DataFrame) -> fr.Table:
    last = fits.iteration == fits.iterations
    columns: dict[str, Any] = {"images": ("image", lambda values: str(values.nunique()))}
    for step in sorted(fits.iteration.unique()):
        columns[f"{step:,}"] = "psnr_ycbcr", _where(fits.iteration == step, fr.mean)
    for title, (figure, write) in ENDS.items():
        columns[title] = figure, _where(last, write)
    return fr.grouped(f"{caption}: PSNR YCbCr / dB by steps", fits, ["set", "method"], columns)


def _where(rows: pd.Series, write: Callable[[pd.Series], str]) -> Callable[[pd.Series], str]:
    return lambda values: write(values[rows.loc[values.index].to_numpy()])

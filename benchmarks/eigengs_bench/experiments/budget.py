"""No more splats than needed: fits of fixed numbers, and what the search for the fewest finds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from eigengs_bench.harness.datasets import images_of
from eigengs_bench.harness.store import Row
from eigengs_bench.harness.task import Task
from eigengs_bench.harness.timing import (
    Image,
    decibels,
    follow,
    require_complete,
    score,
    warm_up,
)
from eigengs_bench.names import SETS
from eigengs_dr.descent import LONG
from eigengs_dr.fitting import fit, most_gaussians
from eigengs_dr.presets import PRESETS
from eigengs_dr.starting import GAUSSIANS, Start, begin

FILE = "budget.jsonl"

SPARSEST = 1024
"""Pixels a splat of the smallest fixed number."""

STEPS_AN_OCTAVE = 2
"""Fixed numbers from one to twice as many, at least."""

Fit = Callable[[int, bool], Row]
"""``fitted(count, rearranged)``: the row of a fit of ``count`` splats, placed anew on the way or
not."""

Search = Callable[[float], Row]
"""``searched(target)``: the row of a search for the fewest splats."""


def run(task: Task, names: Sequence[str], targets: Sequence[float]) -> list[Row]:
    """Measure sets, image by image, what is compared in turn.

    Parameters
    ----------
    task : Task
        With fewer iterations than `LONG` times `Schedule.rearrange`, no fit places its splats anew.
    names : sequence of str
        Of `SETS`, or `SAMPLES`.
    targets : sequence of float
        Decibels of psnr_ycbcr.

    Returns
    -------
    list of dict
        Rows of all `parts`, a fit that two of them need twice, with "job": set, image, iterations,
        seed. The job of a fit has also gaussians and rearranged, and its row the figures of
        `score`. The job of a search has also target, and its row gaussians, stopped, iterations,
        seconds (all of `fit`, what it measures on its way included), psnr_ycbcr and psnr_rgb.

    Raises
    ------
    ValueError
        If a set is not there.
    """
    found: list[Row] = []
    for name in names:
        pictures = images_of(task, name)
        usual = SETS[name].gaussians if name in SETS else GAUSSIANS
        total, done = len(pictures) * (3 * len(targets) + 2), 0
        task.progress(name, done, total)
        for file, image in pictures:
            measured = _measured(task, name, file, image)
            count = min(usual, image.shape[0] * image.shape[1])
            for part in parts(grid(image), targets, count, *measured):
                found += part
                done += 1
                task.progress(name, done, total)
    return found


def grid(image: Image) -> list[int]:
    """Fixed numbers of splats for an image of shape (H, W, C), ascending.

    From one for `SPARSEST` pixels to the most that a search uses, each at most the root of two
    times the one before.
    """
    most = most_gaussians(image)
    least = min(most, math.ceil(image.shape[0] * image.shape[1] / SPARSEST))
    steps = math.ceil(STEPS_AN_OCTAVE * math.log2(most / least))
    return sorted({round(count) for count in np.geomspace(least, most, steps + 1)})


def parts(
    counts: Sequence[int], targets: Sequence[float], usual: int, fitted: Fit, searched: Search
) -> Iterator[list[Row]]:
    """Compare on one image, and yield the rows of each of ``3 len(targets) + 2`` parts.

    For every target the fits of fixed numbers around it, without placing anew; then for every
    target the search, and a fit of the number that it found; then fits of the usual number without
    and with placing anew.
    """
    for target in targets:
        yield bisect(counts, target, lambda count: fitted(count, False))
    for target in targets:
        search = searched(target)
        yield [search]
        yield [fitted(search["gaussians"], True)]
    yield [fitted(usual, False)]
    yield [fitted(usual, True)]


def bisect(counts: Sequence[int], target: float, fitted: Callable[[int], Row]) -> list[Row]:
    """Fit until two neighbours are known, of which the first misses a target and the second not.

    Or the smallest number, if that reaches it; or the largest, if that does not. Searches for
    several targets begin with the same numbers.
    """
    looked: list[Row] = []
    low, high = -1, len(counts)
    while high - low > 1:
        middle = (low + high) // 2
        looked.append(fitted(counts[middle]))
        value = looked[-1]["psnr_ycbcr"]  # null in JSON where a fit has failed
        if value is not None and value >= target:
            high = middle
        else:
            low = middle
    return looked


def _measured(task: Task, name: str, file: str, image: Image) -> tuple[Fit, Search]:
    """Functions that measure on one image what the file does not hold yet."""
    shared = {"set": name, "image": file, "iterations": task.iterations, "seed": task.seed}

    def one(job: Row, work: Callable[[], Row]) -> Row:
        (row,) = task._replace(progress=lambda *_: None).measure(FILE, [(job, work)], name)
        return row

    def fitted(count: int, rearranged: bool) -> Row:
        job = {**shared, "gaussians": count, "rearranged": rearranged}
        return one(job, partial(_fit, task, image, count, rearranged))

    def searched(target: float) -> Row:
        return one({**shared, "target": float(target)}, partial(_search, task, image, target))

    return fitted, searched


def _fit(task: Task, image: Image, count: int, rearranged: bool) -> Row:
    method = PRESETS["default"]

    def start() -> Start:
        settings = (count, "auto", "natural", method)
        begun = begin(image, *settings, seed=task.seed, backend=task.backend)
        return begun if rearranged else begun._replace(rearrange=None)

    warm_up(start, method.schedule, task.iterations)
    (moment,) = follow(start, method.schedule, task.iterations, (task.iterations,))
    return score(moment, image)


def _search(task: Task, image: Image, target: float) -> Row:
    search = partial(fit, image, target_psnr=target, seed=task.seed, backend=task.backend)
    for steps in (min(LONG, task.iterations), task.iterations):  # first untimed, to compile
        found = require_complete(search(iterations=steps))
    return {
        "gaussians": len(found.gaussians),
        "stopped": found.stopped,
        "iterations": found.iterations,
        "seconds": found.seconds,
        "psnr_ycbcr": decibels(found.image, image, "ycbcr"),
        "psnr_rgb": decibels(found.image, image, "rgb"),
    }

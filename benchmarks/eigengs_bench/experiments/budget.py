"""No more splats than needed: fits of fixed numbers, and what the search for the fewest finds.

The job of a fit has "gaussians" and "rearranged", and its row the figures of `score`. The job of a
search has "target", and its row gaussians, stopped, iterations, seconds, psnr_ycbcr and psnr_rgb.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from eigengs_bench.harness.datasets import images_of, usual_count
from eigengs_bench.harness.store import Row, Task
from eigengs_bench.harness.timing import Image, decibels, follow, score, warm_up
from eigengs_dr.fitting.fit import fit
from eigengs_dr.fitting.initializers import FitProblem, initialize
from eigengs_dr.fitting.optimizers.schedule import MIN_PHASE_RATIO
from eigengs_dr.fitting.options import FitOptions, max_gaussians_for

FILE = "budget.jsonl"

SPARSEST = 1024  # pixels a splat of the smallest fixed number
STEPS_AN_OCTAVE = 2  # fixed numbers from one to twice as many, at least


def run(task: Task, names: Sequence[str], targets: Sequence[float]) -> list[Row]:
    """Measure sets, image by image; a fit that two of the `parts` need is in the rows twice."""
    found: list[Row] = []
    for name in names:
        pictures = images_of(task, name)
        total, done = len(pictures) * (3 * len(targets) + 2), 0
        for file, image in pictures:
            about = {"set": name, "image": file, "iterations": task.iterations, "seed": task.seed}
            count = min(usual_count(name), image.shape[0] * image.shape[1])
            measured = _measured(task, about, image)
            for part in parts(grid(image), targets, count, *measured):
                found += part
                done += 1
                task.progress(name, done, total)
    return found


def grid(image: Image) -> list[int]:
    """Fixed numbers of splats: from one for `SPARSEST` pixels to the most that a search uses."""
    most = max_gaussians_for(image)
    least = min(most, math.ceil(image.shape[0] * image.shape[1] / SPARSEST))
    steps = math.ceil(STEPS_AN_OCTAVE * math.log2(most / least))
    return sorted({round(count) for count in np.geomspace(least, most, steps + 1)})


def parts(
    counts: Sequence[int],
    targets: Sequence[float],
    usual: int,
    fitted: Callable[[int, bool], Row],
    searched: Callable[[float], Row],
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
        value = looked[-1]["psnr_ycbcr"]  # None where a fit has failed
        low, high = (low, middle) if value is not None and value >= target else (middle, high)
    return looked


def _measured(
    task: Task, about: Row, image: Image
) -> tuple[Callable[[int, bool], Row], Callable[[float], Row]]:
    """Functions that measure on one image what the file does not hold yet."""
    quiet = task._replace(progress=lambda *_: None)

    def fitted(count: int, rearranged: bool) -> Row:
        job = {**about, "gaussians": count, "rearranged": rearranged}
        return quiet.measure(FILE, [(job, partial(_fit, task, image, count, rearranged))], "")[0]

    def searched(target: float) -> Row:
        job = {**about, "target": float(target)}
        return quiet.measure(FILE, [(job, partial(_search, task, image, target))], "")[0]

    return fitted, searched


def _fit(task: Task, image: Image, count: int, rearranged: bool) -> Row:
    options = FitOptions(gaussians=count, seed=task.seed, backend=task.backend)
    schedule = options.method.schedule

    def start() -> FitProblem:
        begun = initialize(image, options)
        return begun if rearranged else begun._replace(redistribute=None)

    warm_up(start, schedule, task.iterations)
    (moment,) = follow(start, schedule, task.iterations, (task.iterations,))
    return score(moment, image)


def _search(task: Task, image: Image, target: float) -> Row:
    search = partial(fit, image, target_psnr=target, seed=task.seed, backend=task.backend)
    search(iterations=min(MIN_PHASE_RATIO, task.iterations))  # untimed, to compile
    found = search(iterations=task.iterations)
    return {
        "gaussians": len(found.gaussians),
        "stopped": found.stopped,
        "iterations": found.iterations,
        "seconds": found.seconds,
        "psnr_ycbcr": decibels(found.image, image, "ycbcr"),
        "psnr_rgb": decibels(found.image, image, "rgb"),
    }

"""The fewest Gaussians for a PSNR: of fits of fixed numbers, and of the search.

Fits that are not "rearranged" keep the first places: they neither redistribute nor relocate.
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
from eigengs_dr.fitting.descent import FitProblem
from eigengs_dr.fitting.fit import fit
from eigengs_dr.fitting.options import FitOptions, max_gaussians_for
from eigengs_dr.fitting.schedule import MIN_PHASE_RATIO
from eigengs_dr.fitting.start import initialize

FILE = "budget.jsonl"

SPARSEST = 1024  # pixels a Gaussian of the smallest fixed number
STEPS_AN_OCTAVE = 2  # fixed numbers from one to twice as many, at least


def run(task: Task, names: Sequence[str], targets: Sequence[float]) -> list[Row]:
    """Measure sets, image by image; a fit that two parts need is in the rows twice."""
    found: list[Row] = []
    for name in names:
        pictures = images_of(task, name)
        total, done = len(pictures) * (3 * len(targets) + 2), 0
        for file, image in pictures:
            count = min(usual_count(name), image.shape[0] * image.shape[1])
            for part in _parts(task, {"set": name, "image": file}, image, targets, count):
                found += part
                done += 1
                task.progress(name, done, total)
    return found


def grid(image: Image) -> list[int]:
    """Fixed numbers of Gaussians: from one for `SPARSEST` pixels to the most of a search."""
    most = max_gaussians_for(image)
    least = min(most, math.ceil(image.shape[0] * image.shape[1] / SPARSEST))
    steps = math.ceil(STEPS_AN_OCTAVE * math.log2(most / least))
    return sorted({round(count) for count in np.geomspace(least, most, steps + 1)})


def bisect(counts: Sequence[int], target: float, fitted: Callable[[int], Row]) -> list[Row]:
    """Fit until two neighbours are known, of which the first misses a target and the second not.

    Or the smallest number, if it reaches the target; or the largest, if it does not. Searches for
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


def _parts(
    task: Task, about: Row, image: Image, targets: Sequence[float], usual: int
) -> Iterator[list[Row]]:
    """Yield the rows of one image, ``3 len(targets) + 2`` parts: what the file lacks is measured.

    For every target the fits of fixed numbers around it, without placing anew; then for every
    target the search, and a fit of the number that it found; then fits of the usual number without
    and with placing anew.
    """
    quiet = task._replace(progress=lambda *_: None)
    about = {**about, "iterations": task.iterations, "seed": task.seed}

    def fitted(count: int, rearranged: bool = False) -> Row:
        job = {**about, "gaussians": count, "rearranged": rearranged}
        return quiet.measure(FILE, [(job, partial(_fit, task, image, count, rearranged))], "")[0]

    for target in targets:
        yield bisect(grid(image), target, fitted)
    for target in targets:
        job = {**about, "target": float(target)}
        found = quiet.measure(FILE, [(job, partial(_search, task, image, target))], "")
        yield found
        yield [fitted(found[0]["gaussians"], True)]
    yield [fitted(usual)]
    yield [fitted(usual, True)]


def _fit(task: Task, image: Image, count: int, rearranged: bool) -> Row:
    options = FitOptions(gaussians=count, seed=task.seed, backend=task.backend)

    def start() -> FitProblem:
        begun = initialize(image, options)
        return begun if rearranged else begun._replace(control=None)

    warm_up(start, options.method.schedule, task.iterations)
    (moment,) = follow(start, options.method.schedule, task.iterations, (task.iterations,))
    return score(moment, image)


def _search(task: Task, image: Image, target: float) -> Row:
    search = partial(fit, image, target_psnr=target, target_space="ycbcr", seed=task.seed)
    search = partial(search, backend=task.backend)
    search(iterations=min(MIN_PHASE_RATIO, task.iterations))  # untimed, to compile
    found = search(iterations=task.iterations)
    return {
        "gaussians": len(found.gaussians),
        **{key: getattr(found, key) for key in ("stopped", "iterations", "seconds")},
        **{f"psnr_{space}": decibels(found.image, image, space) for space in ("ycbcr", "rgb")},
    }

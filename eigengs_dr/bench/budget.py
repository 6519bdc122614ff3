"""No more splats than needed: fits of fixed numbers, and what the search for the fewest finds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..fitting.fit import fit
from ..fitting.initializers import FitProblem, initialize
from ..fitting.optimizers.schedule import MIN_PHASE_RATIO
from ..fitting.options import DEFAULT_COUNT, max_gaussians_for
from ..fitting.presets import PRESETS
from . import rows
from .rate import images_of
from .rows import Row
from .sets import SETS
from .trial import decibels, follow, judged, warm_up, whole

Image = NDArray[np.float32]

TARGETS = (32.0, 36.0, 40.0)
"""Decibels of psnr_ycbcr that splats are counted for."""

SPARSEST = 1024
"""Pixels a splat of the smallest fixed number."""

STEPS_AN_OCTAVE = 2
"""Fixed numbers from one to twice as many, at least."""

Fitted = Callable[[int, bool], Row]
"""``fitted(count, rearranged)``: the row of a fit of so many splats, placed anew on the way or
not."""

Searched = Callable[[float], Row]
"""``searched(target)``: the row of a search for the fewest splats."""

Progress = Callable[[str, int, int], None]


def run(
    data: Path | None,
    folder: Path,
    names: Sequence[str],
    images: int,
    iterations: int,
    targets: Sequence[float],
    gaussians: int | None,
    seed: int,
    about: Row,
    backend: str | None = None,
    progress: Progress = lambda label, done, total: None,
) -> list[Row]:
    """Measure sets, image by image, what is compared in turn.

    Parameters
    ----------
    data : Path or None
        See `sets`.
    folder : Path
        Where ``budget.jsonl`` is continued.
    names : sequence of str
        Of `SETS`, or "samples".
    images : int
        How many of a set, at most.
    iterations : int
        Steps of every fit, and what the search is told; with fewer than `MIN_PHASE_RATIO` times
        `Schedule.rearrange`, no fit places its splats anew.
    targets : sequence of float
        Decibels of psnr_ycbcr.
    gaussians : int or None
        Splats of the comparison of starts, or one a pixel if these are fewer; by default the number
        of the set.
    seed : int
    about : dict
        What lines say of their run, see `rows.measure`.
    backend : {"llvm", "cuda"}, optional
    progress : callable, optional
        ``progress(label, done, total)``.

    Returns
    -------
    list of dict
        Rows of all `parts`, a fit that two of them need twice, with "job": set, image, iterations,
        seed. The job of a fit has also gaussians and rearranged, and its row the figures of
        `trial.judged`, seconds counted from before the first splat is placed. The job of a search
        has also target, and its row gaussians, stopped, iterations, seconds (all of `fit`, what it
        measures on its way included), psnr_ycbcr and psnr_rgb.

    Raises
    ------
    ValueError
        If a set is not there.
    """
    found: list[Row] = []
    for name in names:
        pictures = images_of(data, name, images)
        usual = gaussians or (SETS[name].gaussians if name in SETS else DEFAULT_COUNT)
        total = len(pictures) * (3 * len(targets) + 2)
        progress(name, 0, total)
        done = 0
        for file, image in pictures:
            shared = {"set": name, "image": file, "iterations": iterations, "seed": seed}
            measured = _measured(folder / "budget.jsonl", shared, about, image, backend)
            count = min(usual, image.shape[0] * image.shape[1])
            for part in parts(grid(image), targets, count, *measured):
                found += part
                done += 1
                progress(name, done, total)
    return found


def grid(image: Image) -> list[int]:
    """Fixed numbers of splats for an image of shape (H, W, C), ascending.

    From one for `SPARSEST` pixels to the most that a search uses, each at most the root of two
    times the one before.
    """
    most = max_gaussians_for(image)
    least = min(most, math.ceil(image.shape[0] * image.shape[1] / SPARSEST))
    steps = math.ceil(STEPS_AN_OCTAVE * math.log2(most / least))
    return sorted({round(count) for count in np.geomspace(least, most, steps + 1)})


def parts(
    counts: Sequence[int],
    targets: Sequence[float],
    usual: int,
    fitted: Fitted,
    searched: Searched,
) -> Iterator[list[Row]]:
    """Compare on one image, and yield the rows of each of ``3 len(targets) + 2`` parts.

    For every target the fits of fixed numbers around it, without placing anew; then for every
    target the search, and a fit of the number that it found; then fits of the usual number without
    and with placing anew.
    """
    for target in targets:
        yield bisected(counts, target, lambda count: fitted(count, False))
    for target in targets:
        search = searched(target)
        yield [search]
        yield [fitted(search["gaussians"], True)]
    yield [fitted(usual, False)]
    yield [fitted(usual, True)]


def bisected(counts: Sequence[int], target: float, fitted: Callable[[int], Row]) -> list[Row]:
    """Fit until two neighbours are known, of which the first misses a target and the second not.

    Or the smallest number, if that reaches it; or the largest, if that does not. Searches for
    several targets begin with the same numbers.
    """
    looked: list[Row] = []
    low, high = -1, len(counts)
    while high - low > 1:
        middle = (low + high) // 2
        looked.append(fitted(counts[middle]))
        if reached(looked[-1]) >= target:
            high = middle
        else:
            low = middle
    return looked


def reached(row: Row) -> float:
    """Return psnr_ycbcr of a row, NaN of a fit that has failed, which is null in JSON."""
    return math.nan if row["psnr_ycbcr"] is None else float(row["psnr_ycbcr"])


def _measured(
    lines: Path, shared: Row, about: Row, image: Image, backend: str | None
) -> tuple[Fitted, Searched]:
    """Functions that measure on one image what the file does not hold yet."""

    def fitted(count: int, rearranged: bool) -> Row:
        job = {**shared, "gaussians": count, "rearranged": rearranged}
        settings = (image, count, rearranged, shared["iterations"], shared["seed"], backend)
        (row,) = rows.measure(lines, [(job, partial(_fit, *settings))], about)
        return row

    def searched(target: float) -> Row:
        job = {**shared, "target": float(target)}
        settings = (image, target, shared["iterations"], shared["seed"], backend)
        (row,) = rows.measure(lines, [(job, partial(_search, *settings))], about)
        return row

    return fitted, searched


def _fit(
    image: Image, count: int, rearranged: bool, iterations: int, seed: int, backend: str | None
) -> Row:
    method = PRESETS["default"]

    def start() -> FitProblem:
        begun = initialize(image, count, "auto", "natural", method, seed=seed, backend=backend)
        return begun if rearranged else begun._replace(redistribute=None)

    warm_up(start, method.schedule, iterations)
    (moment,) = follow(start, method.schedule, iterations, (iterations,))
    return judged(moment, image)


def _search(image: Image, target: float, iterations: int, seed: int, backend: str | None) -> Row:
    for steps in (min(MIN_PHASE_RATIO, iterations), iterations):  # first untimed, to compile
        found = whole(fit(image, iterations=steps, target_psnr=target, seed=seed, backend=backend))
    return {
        "gaussians": len(found.gaussians),
        "stopped": found.stopped,
        "iterations": found.iterations,
        "seconds": found.seconds,
        "psnr_ycbcr": decibels(found.image, image, "ycbcr"),
        "psnr_rgb": decibels(found.image, image, "rgb"),
    }

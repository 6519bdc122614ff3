"""Levels of detail: one set whose first N Gaussians already form the image, for several N.

Placement adds one level after the other, with more Gaussians where the residual of the earlier
levels has larger second derivatives. Refinement then moves all levels together and minimises the
sum of the logarithms of their squared errors. In its first two thirds, Gaussians of little use
relocate inside of their levels. Sorting the Gaussians of a plain fit by their removal cost does not
work: they depend on each other, and the first quarter does not form an image.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..backend.feedback import defer_interrupts, shows_progress
from ..backend.recording import exclusive
from ..gaussian.gaussians import Gaussians, concatenate
from .density_control import LevelControl, removal_cost
from .descent import FitProblem, run
from .fit import Fit, finish
from .options import FitOptions, Levels, named_options
from .placement.adaptive import place_like, residual
from .refine import FitProgress, Refinement, Score, measure, refine
from .schedule import Schedule
from .start import start_from_placement
from .target import FitTarget, in_unit, make_target, read_pixels, unit_of

LEVEL_RATIO = 4
"""Ratio of the numbers of Gaussians up to a level and up to the level before it; 4 halves their
spacing."""

STEPS_PER_LEVEL = 50
"""Refinement steps between the placements of two levels."""


def level_counts(count: int, levels: Levels) -> list[int]:
    """Return the number of Gaussians up to each level.

    Parameters
    ----------
    count : int
        Number of Gaussians of the whole set.
    levels : int or sequence of int
        Number of levels, with the whole set: each level has `LEVEL_RATIO` times as many Gaussians
        as the one before. Or the number of Gaussians up to each level; the last is `count`.

    Returns
    -------
    list of int
        In ascending order; the last is `count`.

    Raises
    ------
    ValueError
        If the first level would have no Gaussian, levels is not positive, or numbers of Gaussians
        do not rise up to `count`.

    Examples
    --------
    >>> level_counts(5000, 4)
    [78, 312, 1250, 5000]
    >>> level_counts(9000, [5000, 7000, 9000])
    [5000, 7000, 9000]
    """
    if not isinstance(levels, (int, np.integer)):
        return _check_counts(count, levels)
    most = 1
    while count >= LEVEL_RATIO**most:
        most += 1
    if not 1 <= levels <= most:
        raise ValueError(f"levels is {levels}; {count} Gaussians make 1 to {most}")
    return [count // LEVEL_RATIO**k for k in reversed(range(levels))]


def _check_counts(count: int | None, levels: Sequence[int]) -> list[int]:
    """Return numbers of Gaussians that rise up to `count`, if that is known."""
    counts, written = list(levels), ", ".join(map(str, levels))
    if not all(isinstance(n, (int, np.integer)) for n in counts):
        raise ValueError(f"levels {written}: numbers of Gaussians must be whole")
    if not counts or not all(a < b for a, b in pairwise([0, *counts])):
        raise ValueError(f"levels {written}: numbers of Gaussians must rise, from 1 or more")
    if count is not None and counts[-1] != count:
        raise ValueError(f"levels {written}: the last must be the number of Gaussians, {count}")
    return [int(n) for n in counts]


def check_options(options: FitOptions, levels: Levels) -> FitOptions:
    """Return the options of a fit in levels; numbers of Gaussians say how many there are in all.

    Raises
    ------
    ValueError
        If the options exclude levels, or contradict them.
    """
    if options.target_psnr is not None:
        raise ValueError("levels and target_psnr exclude each other; give one of them")
    if options.preset != "default" or options.placement != "adaptive":
        raise ValueError("levels needs preset 'default' and init 'adaptive'; leave the others out")
    if isinstance(levels, (int, np.integer)):
        return options
    return replace(options, gaussians=_check_counts(options.gaussians, levels)[-1])


@named_options
@shows_progress
@exclusive()
def fit_levels(
    image: ArrayLike,
    gaussians: int | None = None,
    levels: Levels = 4,
    iterations: int = 1000,
    space: str = "ycbcr",
    seed: int = 0,
    backend: str | None = None,
    progress: Any = None,
    encoding: str | None = None,
) -> Fit:
    """Fit nested sets: the first Gaussians form the image too, for several numbers of them.

    Parameters
    ----------
    image : array_like, shape (H, W, 3), (H, W, 1) or (H, W)
        See `eigengs_dr.fit`.
    gaussians : int, optional
        Number of Gaussians; by default the last of `levels`, or 5000, or one per pixel for smaller
        images.
    levels : int or sequence of int, optional
        The number of Gaussians up to each level, such as ``[5000, 7000, 9000]``; or the number of
        levels, of which each has 4 times as many Gaussians as the one before: `level_counts`
        returns how many. Inside a level, Gaussians with a larger removal cost come first, so that
        every prefix forms an image.
    iterations : int, optional
        Largest number of refinement steps of the whole set.
    space : {"ycbcr", "rgb", "linear", "radiance", "log", "normal", "data"}, optional
        See `eigengs_dr.fit`.
    seed : int, optional
        Not used: the placement draws no random numbers.
    backend : {"llvm", "cuda"}, optional
    progress : bool or callable, optional
        By default a bar, in a terminal or a notebook, after two seconds; False shows none.
        ``progress(iteration, iterations, row)``, see `eigengs_dr.fit`.
    encoding : {"srgb", "linear"}, optional
        What the pixels are, see `eigengs_dr.fit`.

    Returns
    -------
    Fit
        ``result.gaussians[:n]`` is a level, for each n of `level_counts`. The trace measures the
        whole set.

    Raises
    ------
    ValueError
        If the image is unusable or an argument is out of range.
    BackendError
        If the backend is not available.
    FitInterrupted
        After Ctrl-C or SIGTERM, see `eigengs_dr.fit`.
    """
    started = time.perf_counter()
    options = FitOptions(
        gaussians=gaussians,
        iterations=iterations,
        space=space,
        seed=seed,
        backend=backend,
        encoding=encoding,
    )
    options = check_options(options, levels)
    pixels, options = read_pixels(image, options)
    options.check_image(pixels)
    unit = unit_of(pixels, options.space)
    if unit != 1:
        pixels = pixels / np.float32(unit)
    score = partial(measure, image=pixels, started=started)
    with defer_interrupts() as interrupted:
        target = make_target(pixels, options.space)
        found, seconds_init = refine_levels(target, options, levels, score, progress, interrupted)
    return finish(found, in_unit(found.gaussians, unit), None, started, seconds_init)


def refine_levels(
    target: FitTarget,
    options: FitOptions,
    levels: Levels,
    score: Score,
    progress: FitProgress | None = None,
    interrupted: Callable[[], bool] = lambda: False,
) -> tuple[Refinement, float]:
    """Place and refine nested sets for a target.

    Parameters
    ----------
    target : FitTarget
    options : FitOptions
        Options that `check_options` returns.
    levels : int or sequence of int
        See `fit_levels`.
    score, progress, interrupted : callable
        See `eigengs_dr.fitting.refine.refine`.

    Returns
    -------
    Refinement
        Its set is sorted by levels.
    float
        Seconds before refinement.
    """
    started = time.perf_counter()
    counts = level_counts(options.count_for(target.values), levels)
    schedule = replace(options.method.schedule, redistribute_after=0)
    start = start_from_placement(target, replace(options, gaussians=counts[0]))
    start = start._replace(control=None)
    steps = min(STEPS_PER_LEVEL, options.iterations)
    placed = _place_levels(start, counts, schedule, steps, interrupted)
    control = LevelControl(target.values, target.weight, target.shown, counts=tuple(counts))
    seconds_init = time.perf_counter() - started
    refined = refine(
        start._replace(gaussians=placed, control=control),
        target.pixels,
        schedule,
        options.iterations,
        levels=counts[:-1],
        progress=progress,
        interrupted=interrupted,
        score=score,
    )
    return refined._replace(gaussians=_sort_levels(refined.gaussians, start, counts)), seconds_init


def _place_levels(
    start: FitProblem,
    counts: list[int],
    schedule: Schedule,
    steps: int,
    interrupted: Callable[[], bool],
) -> Gaussians:
    """Add levels to the first one; place each by the residual after some steps without it."""
    gaussians = start.gaussians
    for level, count in enumerate(counts[1:], 1):
        below = counts[: level - 1]
        problem = start._replace(gaussians=gaussians)
        gaussians = run(problem, schedule, steps, lambda *_: interrupted(), levels=below)
        left = residual(gaussians, start.target)
        added = place_like(gaussians, left, left, count - len(gaussians))
        # The background is one for all levels: a new one would change the earlier levels.
        gaussians = concatenate([gaussians, replace(added, background=0 * added.background)])
    return gaussians


def _sort_levels(gaussians: Gaussians, start: FitProblem, counts: list[int]) -> Gaussians:
    """Sort the Gaussians inside each level by their removal cost, the largest first."""
    order, before = [], 0
    for count in counts:
        value = removal_cost(gaussians[:count], start.target, start.weight)
        own = np.arange(before, count)
        order.append(own[np.argsort(-value[own], kind="stable")])
        before = count
    return gaussians[np.concatenate(order)]

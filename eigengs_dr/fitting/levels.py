"""Levels of detail: one set whose first splats, for some numbers of them, make the image too.

Splats are placed level by level, those of each where the ones before leave most to bend, and all
are refined together on the sum of the decibels of all levels. Sorting a plain fit by what its
splats are worth does not do: they lean on each other, and the first quarter makes no image.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike

from ..backend.interrupt import defer_interrupts
from ..gaussian.gaussians import Gaussians, concatenate
from ..image.io import check_image
from .density_control import removal_cost
from .fit import Fit, finish
from .initializers import FitProblem, initialize
from .optimizers.descent import descend
from .optimizers.schedule import Schedule
from .options import FitOptions
from .redistribute import place_like, residual
from .refine import FitProgress, refine

LEVEL_RATIO = 4
"""Splats of a level over those of the one before: half the distance between them."""

STEPS_PER_LEVEL = 50
"""Steps of refinement after a level is added, before the next one is placed."""


def level_counts(count: int, levels: int) -> list[int]:
    """Numbers of splats up to each level, the last being `count`.

    Raises
    ------
    ValueError
        If the first level would have no splat, or levels is not positive.

    Examples
    --------
    >>> level_counts(5000, 4)
    [78, 312, 1250, 5000]
    """
    most = 1
    while count >= LEVEL_RATIO**most:
        most += 1
    if not 1 <= levels <= most:
        raise ValueError(f"levels is {levels}; {count} Gaussians make 1 to {most}")
    return [count // LEVEL_RATIO**k for k in reversed(range(levels))]


def fit_levels(
    image: ArrayLike,
    gaussians: int | None = None,
    levels: int = 4,
    iterations: int = 1000,
    color: str = "ycbcr",
    seed: int = 0,
    backend: str | None = None,
    progress: FitProgress | None = None,
) -> Fit:
    """Fit Gaussians of which the first quarter makes the image too, and the first quarter of that.

    Parameters
    ----------
    gaussians : int, optional
        Number of splats; by default 5000, or one a pixel if these are fewer.
    levels : int, optional
        How often the set is quartered, and the whole: `level_counts` tells the numbers. Splats of
        one level that are worth more come first, so that all numbers between make an image.
    image, iterations, color, seed, backend, progress
        See `eigengs_dr.fit`.

    Returns
    -------
    Fit
        ``result.gaussians[:n]`` for the levels n. The trace tells of the whole set.

    Raises
    ------
    ValueError
        If the image is unusable or an argument out of range; one line.
    BackendError
        If the backend is not there.
    """
    started = time.perf_counter()
    options = FitOptions(
        gaussians=gaussians, iterations=iterations, color=color, seed=seed, backend=backend
    )
    pixels = check_image(image, keep_grey=color == "data")
    options.check_image(pixels)
    counts = level_counts(options.count_for(pixels), levels)
    schedule = options.method.schedule
    with defer_interrupts() as interrupted:
        start = initialize(pixels, replace(options, gaussians=counts[0]))
        steps = min(STEPS_PER_LEVEL, iterations)
        placed = _place_levels(start, counts, schedule, steps, interrupted)
        seconds_init = time.perf_counter() - started
        refined = refine(
            start._replace(gaussians=placed, redistribute=None),
            pixels,
            schedule,
            iterations,
            started=started,
            levels=counts[:-1],
            progress=progress,
            interrupted=interrupted,
        )
        ordered = _sort_levels(refined.gaussians, start, counts)
    return finish(refined, ordered, None, started, seconds_init)


def _place_levels(
    start: FitProblem,
    counts: list[int],
    schedule: Schedule,
    steps: int,
    interrupted: Callable[[], bool],
) -> Gaussians:
    """Add levels to the first one, each placed on what those before it leave after some steps."""
    gaussians = start.gaussians
    for level, count in enumerate(counts[1:], 1):
        below = counts[: level - 1]
        problem = start._replace(gaussians=gaussians, redistribute=None)
        sets = descend(problem, schedule, steps, levels=below)
        for current in sets:
            gaussians = current
            if interrupted():
                break
        gaussians = dr.detach(gaussians)
        left = residual(gaussians, start.target)
        added = place_like(gaussians, left, left, count - len(gaussians))
        # A background of their own would be part of the levels before.
        gaussians = concatenate([gaussians, replace(added, background=0 * added.background)])
    return gaussians


def _sort_levels(gaussians: Gaussians, start: FitProblem, counts: list[int]) -> Gaussians:
    """Sort the splats of each level, those that are worth most to it first."""
    order, before = [], 0
    for count in counts:
        value = removal_cost(gaussians[:count], start.target, start.weight)
        own = np.arange(before, count)
        order.append(own[np.argsort(-value[own], kind="stable")])
        before = count
    return gaussians[np.concatenate(order)]

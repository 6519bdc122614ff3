"""Levels of detail: one set whose first N Gaussians already form the image, for several N.

Placement adds one level after the other, with more Gaussians where the residual of the earlier
levels has larger second derivatives. Refinement then moves all levels together and minimises the
sum of the logarithms of their squared errors. In its first two thirds, Gaussians of little use
relocate inside of their levels. Sorting the Gaussians of a plain fit by their removal cost does not
work: they depend on each other, and the first quarter does not form an image.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..backend.arrays import types_of
from ..gaussian.gaussians import Gaussians, concatenate
from .density_control import LevelControl, removal_cost
from .descent import FitProblem, run
from .options import FitOptions, level_counts
from .placement.adaptive import place_adaptive, residual
from .refine import FitProgress, Refinement, Score, refine
from .schedule import Schedule
from .solvers.conjugate_gradient import solve
from .start import start_from_placement
from .target import FitTarget

STEPS_PER_LEVEL = 50
"""Refinement steps between the placements of two levels."""


def refine_levels(
    target: FitTarget,
    options: FitOptions,
    score: Score,
    started: float,
    progress: FitProgress | None = None,
    interrupted: Callable[[], bool] = lambda: False,
) -> tuple[Refinement, float]:
    """Place and refine nested sets for a target.

    Parameters
    ----------
    target : FitTarget
    options : FitOptions
        With levels.
    score : callable
        See `eigengs_dr.fitting.refine.refine`.
    started : float
        Value of `time.perf_counter()` at the start of the fit.
    progress, interrupted : callable, optional
        See `eigengs_dr.fitting.refine.refine`.

    Returns
    -------
    Refinement
        Its set is sorted by levels.
    float
        Seconds before refinement.
    """
    assert options.levels is not None
    counts = level_counts(options.count_for(target.values), options.levels)
    schedule = replace(options.method.schedule, redistribute_after=0)
    start = start_from_placement(target, replace(options, gaussians=counts[0], levels=None))
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
        kind = gaussians.space, types_of(gaussians.mean).backend, gaussians.cutoff
        added = place_adaptive(left, count - len(gaussians), *kind)
        added = solve(added, left)
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

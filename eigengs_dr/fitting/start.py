"""What a fit starts from: a set of the user, the file of a set, a model, or levels of detail.

Levels are one set whose first N Gaussians already form the image, for several N. Placement adds one
level after another, with more Gaussians where the residual of the earlier levels has larger second
derivatives. Refinement then moves all levels together and minimises the sum of the logarithms of
their squared errors. In its first two thirds, Gaussians of little use relocate inside of their
levels. Sorting the Gaussians of a plain fit by their removal cost does not work: they depend on
each other, and the first quarter does not form an image.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace

import drjit as dr

from ..backend.arrays import types_of
from ..gaussian.gaussians import Fitted, Gaussians, concatenate, set_of
from ..image.space import Space
from .exchange import MAX_ERROR, merged
from .loop import Descent, descend
from .method import Method, Model
from .objective import Objective, Pixels
from .options import FitOptions, Start
from .redistribution import error_by_pixel
from .state import begin

MAX_RATIO = 0.75
"""Largest squared error of a set with Gaussians of a start over that of a placement, which gains
more from the steps that follow than Gaussians which are fitted already."""

TRUSTED_STEPS = 100
"""Steps of a descent from which on `MAX_ERROR` holds; for fewer it rises, to 1 for none."""


def load_start(start: Start | Fitted, backend: str | None) -> Gaussians | Model:
    """Return the set or the model of a start, without the derivatives of the caller.

    Raises
    ------
    ValueError
        If the set is on another backend, or its file holds no set.
    TypeError
        If the start is something else.
    """
    if isinstance(start, (str, os.PathLike)):
        return Gaussians.load(start, backend)
    loaded = start if isinstance(start, Model) else dr.detach(set_of(start))
    current = types_of(set_in(loaded).mean).backend
    if backend not in (None, current):
        raise ValueError(
            f"the start is on backend {current!r}, not on {backend!r}; load it with "
            f"backend={backend!r}, or leave the backend out"
        )
    return loaded


def set_in(start: Gaussians | Model) -> Gaussians:
    """Return the set of a start."""
    return start if isinstance(start, Gaussians) else start.gaussians


def check_start(
    start: Gaussians, size: tuple[int, int], channels: int, space: Space, options: FitOptions
) -> None:
    """Raise ValueError unless a start fits the image and the options."""
    count, (width, height) = len(start), size
    if options.gaussians not in (None, count):
        raise ValueError(
            f"gaussians is {options.gaussians}, but the start has {count}; leave the number or "
            "the start out"
        )
    if count > width * height:
        raise ValueError(
            f"the start has {count} Gaussians, more than an image of {width}x{height} has pixels; "
            "leave the start out"
        )
    if space != start.space:
        raise ValueError(
            f"space is {space!r}, but the start is in {start.space!r}; use space "
            f"{start.space!r}, or another start"
        )
    if channels != start.channels:
        raise ValueError(
            f"the image has {channels} channels, but the start has {start.channels}; use another "
            "start"
        )


def keep_fitting(
    start: Gaussians, objective: Pixels, method: Method, iterations: int, seed: int
) -> tuple[Gaussians, int]:
    """Keep the Gaussians of a start where they fit an image much better than a placement does.

    See `merged`. If the whole is not much better than the placement, see `MAX_RATIO`, the placement
    is the start. Cost: a placement, three colour solves and a pruning, about 30 steps long; where
    all Gaussians stay, a placement and a solve.

    Parameters
    ----------
    start : Gaussians
        A set with the best colours for the image.
    objective : Pixels
    method : Method
    iterations : int
        Steps of the descent that follows.
    seed : int
        Seed of the placement.

    Returns
    -------
    Gaussians
        As many as the start has.
    kept : int
        How many of them are Gaussians of the start.
    """
    placed = method.place_and_solve(objective, len(start), seed)
    largest = 1 - (1 - MAX_ERROR) * min(1, iterations / TRUSTED_STEPS)
    both, kept = merged(start, placed, objective, len(start), largest, method.solve_steps)
    with dr.suspend_grad():
        old, new = (dr.sum(error_by_pixel(one, objective))[0] for one in (both, placed))
    return (both, kept) if old <= MAX_RATIO * new else (placed, 0)


STEPS_PER_LEVEL = 50
"""Largest number of refinement steps between the placements of two levels."""


def place_levels(descent: Descent, counts: Sequence[int], iterations: int) -> Gaussians:
    """Place nested sets: each level by the error after some steps of the earlier levels.

    Parameters
    ----------
    descent : Descent
        Its objective has no levels.
    counts : sequence of int
        Numbers of Gaussians up to each level.
    iterations : int
        Steps of the refinement that follows; placement takes at most `STEPS_PER_LEVEL` per level.
    """
    image, key = descent.objective.image, descent.key
    steps, method = min(STEPS_PER_LEVEL, iterations), replace(descent.method, controls=())
    gaussians = method.place_and_solve(image, counts[0], key)
    for level, count in enumerate(counts[1:], 1):
        nested = Objective(replace(image, levels=tuple(counts[: level - 1])))
        with closing(descend(nested, method, begin(gaussians), steps, key)) as states:
            for state in states:
                gaussians = state.gaussians
                if descent.interrupted():
                    break
        gaussians = dr.detach(gaussians)
        added = method.place_and_solve(image.minus(gaussians), count - len(gaussians), key)
        # All levels share the background: a new one would change the earlier levels.
        gaussians = concatenate([gaussians, replace(added, background=0 * added.background)])
    return gaussians

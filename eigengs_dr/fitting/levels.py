"""Levels of detail: one set whose first N Gaussians already form the image, for several N.

Placement adds one level after another, with more Gaussians where the residual of the earlier
levels has larger second derivatives. Refinement then moves all levels together and minimises the
sum of the logarithms of their squared errors. In its first two thirds, Gaussians of little use
relocate inside of their levels. Sorting the Gaussians of a plain fit by their removal cost does not
work: they depend on each other, and the first quarter does not form an image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace

import drjit as dr
import numpy as np

from ..gaussian.gaussians import Gaussians, concatenate
from .control import removal_cost
from .loop import descend
from .method import Method
from .objective import Pixels
from .state import begin

STEPS_PER_LEVEL = 50
"""Largest number of refinement steps between the placements of two levels."""


def place_levels(
    objective: Pixels,
    method: Method,
    counts: Sequence[int],
    iterations: int,
    key: int,
    interrupted: Callable[[], bool],
) -> Gaussians:
    """Place nested sets: each level by the error after some steps of the earlier levels.

    Parameters
    ----------
    objective : Pixels
        An objective without levels.
    method : Method
    counts : sequence of int
        Numbers of Gaussians up to each level.
    iterations : int
        Steps of the refinement that follows; placement takes at most `STEPS_PER_LEVEL` per level.
    key, interrupted
        See `eigengs_dr.fitting.loop.refine`.
    """
    steps, method = min(STEPS_PER_LEVEL, iterations), replace(method, controls=())
    gaussians = method.place_and_solve(objective, counts[0], key)
    for level, count in enumerate(counts[1:], 1):
        nested = replace(objective, levels=tuple(counts[: level - 1]))
        with closing(descend(nested, method, begin(gaussians), steps, key)) as states:
            for state in states:
                gaussians = state.gaussians
                if interrupted():
                    break
        gaussians = dr.detach(gaussians)
        added = method.place_and_solve(objective.minus(gaussians), count - len(gaussians), key)
        # All levels share the background: a new one would change the earlier levels.
        gaussians = concatenate([gaussians, replace(added, background=0 * added.background)])
    return gaussians


def sort_levels(gaussians: Gaussians, objective: Pixels, counts: Sequence[int]) -> Gaussians:
    """Sort the Gaussians inside each level by their removal cost, the largest first."""
    order, before = [], 0
    for count in counts:
        value = removal_cost(gaussians[:count], objective)
        indices = np.arange(before, count)
        order.append(indices[np.argsort(-value[indices], kind="stable")])
        before = count
    return gaussians[np.concatenate(order)]

"""The search of the step: the largest whose error stays within a limit, by few attempts.

The error of rounding grows with about the square of the step, but every step rounds all numbers
anew, and the sum of their errors is random: by 10 % of the budget for 100 Gaussians, and 1 % for
3,000. So each attempt tells where the error should cross the limit, and the next attempt is there,
or a little below it while no attempt was within the limit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .egs import EgsContent

MIN_OCTAVES, MAX_OCTAVES = -14.0, 6.0
"""Range of the search around the first step, in octaves."""

MAX_MOVE = 2.0
"""Largest distance of two attempts, in octaves."""

ENOUGH = 0.97
"""Part of the budget that leaves no room worth another attempt."""

ATTEMPTS = 4
"""Attempts, after which the search takes the best one if any is within the limit."""

MARGIN = 0.01
"""Octaves below the crossing at which the next attempt is."""


class Attempt(NamedTuple):
    """One step and what it gives.

    Attributes
    ----------
    excess : float
        Error that rounding adds, relative to the largest that the budget allows.
    packed : EgsContent
        The rounded set.
    """

    excess: float
    packed: EgsContent


def largest_within(
    attempt: Callable[[float], Attempt], start: float = 0.0, attempts: int = ATTEMPTS
) -> tuple[float, Attempt] | None:
    """Search the largest step within the limit.

    Parameters
    ----------
    attempt : callable
        ``attempt(octaves)`` rounds with ``2**octaves`` times some first step.
    start : float, optional
        Octaves of the first attempt.
    attempts : int, optional

    Returns
    -------
    (float, Attempt) or None
        The octaves and the attempt; None if the smallest step exceeds the limit.
    """
    octaves, number, margin = start, 0, MARGIN
    best: tuple[float, Attempt] | None = None
    while number < attempts or best is None:
        found = attempt(octaves)
        number += 1
        if found.excess <= 1 and (best is None or octaves > best[0]):
            best = octaves, found
        if best and (best[1].excess >= ENOUGH or best[0] >= MAX_OCTAVES):
            break
        if best is None and octaves <= MIN_OCTAVES:
            return None
        move = -0.5 * np.log2(max(found.excess, 1e-9)) - margin
        octaves = float(octaves + np.clip(move, -MAX_MOVE, MAX_MOVE))
        octaves = min(max(octaves, MIN_OCTAVES), MAX_OCTAVES)
        margin *= 2 if best is None else 1
        if best and octaves <= best[0]:  # an unlucky attempt above; look between
            octaves = best[0] + MARGIN
    return best

"""The search of the step: the largest whose error stays within a limit, by few attempts.

The error is about ``e_0 + k step^2``: rounding adds error, and the compensation for it may improve
the set. Every step rounds all numbers anew, so the error is random too: by 10 % of the budget for
100 Gaussians, and 1 % for 3,000. The last two attempts tell e_0 and k, and with them the step at
which the error should cross the limit. The next attempt is there, or a little below it.
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

ENOUGH, ATTEMPTS = 0.97, 4
"""Part of the budget that leaves no room worth another attempt, and number of attempts."""

FAIR, MAX_ATTEMPTS = 0.9, 10
"""Part of the budget that must be used after `ATTEMPTS`, and attempts after which it need not."""

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
    attempt: Callable[[float], Attempt], start: float = 0.0, least: float = MIN_OCTAVES
) -> tuple[float, Attempt] | None:
    """Search the largest step within the limit.

    Parameters
    ----------
    attempt : callable
        ``attempt(octaves)`` rounds with ``2**octaves`` times some first step.
    start : float, optional
        Octaves of the first attempt.
    least : float, optional
        Octaves of the smallest step to try.

    Returns
    -------
    (float, Attempt) or None
        The octaves and the attempt; None if the smallest step exceeds the limit.
    """
    octaves, tried = start, list[tuple[float, float]]()
    best: tuple[float, Attempt] | None = None
    while True:
        found = attempt(octaves)
        tried.append((octaves, found.excess))
        if found.excess <= 1 and (best is None or octaves > best[0]):
            best = octaves, found
        goal = _crossing(tried) - MARGIN
        if best is None:
            if octaves <= least:
                return None
            lowest = min(place for place, _ in tried)
            octaves = max(min(goal, lowest - MARGIN * len(tried)), least)
            continue
        low = best[0] + MARGIN
        high = min((place for place, _ in tried if place > best[0]), default=MAX_OCTAVES + MARGIN)
        if low > high - MARGIN or _is_enough(best, len(tried)):
            return best
        octaves = min(max(goal, low), high - MARGIN)


def _is_enough(best: tuple[float, Attempt], number: int) -> bool:
    """Return whether the best of a number of attempts is good enough."""
    used = best[1].excess
    if used >= ENOUGH or number >= MAX_ATTEMPTS:
        return True
    return number >= ATTEMPTS and used >= FAIR


def _crossing(tried: list[tuple[float, float]]) -> float:
    """Return the octaves at which the error should cross the limit."""
    octaves, excess = tried[-1]
    offset, slope = 0.0, excess * 4.0**-octaves
    before, error = tried[max(len(tried) - 2, 0)]
    if before != octaves:
        slope = (excess - error) / (4.0**octaves - 4.0**before)
        offset = excess - slope * 4.0**octaves
    if slope <= 0 or offset >= 1:  # noise, or an improvement: go on by the larger steps
        return octaves + (MAX_MOVE if excess <= 0 else float(np.clip(1 - excess, -1, 1)))
    crossing = 0.5 * np.log2(max((1 - offset) / slope, 1e-30))
    return octaves + float(np.clip(crossing - octaves, -MAX_MOVE, MAX_MOVE))

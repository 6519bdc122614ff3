"""The rounds of a fit by blocks, between which neighbours see what the others have drawn."""

from __future__ import annotations

from itertools import pairwise

from ..fitting.schedule import Schedule, relocations

SHORT_ROUNDS, LAST_ROUNDS = 3, 5
"""Rounds of a descent without relocation, and rounds after the last relocation. More rounds lose
what the optimiser knows; fewer leave seams. On 1,024x1,024 pixels in blocks of 256, 2 to 4 short
rounds were alike, and better than 1 or 6."""


def rounds(schedule: Schedule, iterations: int) -> list[range]:
    """Return the steps of every round of a descent.

    Gaussians relocate before the first step of a round, so that neighbours do so at once and see
    each other's new places at the end of the round.

    Examples
    --------
    >>> rounds(Schedule("adam", {"color": 0.01}), 30)
    [range(0, 10), range(10, 20), range(20, 30)]
    """
    cuts = [0, *relocations(schedule, iterations)]
    number, last = LAST_ROUNDS if cuts[1:] else SHORT_ROUNDS, cuts.pop()
    number = max(1, min(number, iterations - last))
    cuts += [last + k * (iterations - last) // number for k in range(number + 1)]
    return [range(start, stop) for start, stop in pairwise(cuts)]

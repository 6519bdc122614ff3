"""The schedule of a refinement: learning rates, their decay, and the builds of tile lists.

This module also holds the registries of optimisers and parameterizations. To add one, write one
file in this folder and add one entry ``module:name`` below; its first use imports it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from .parameterization import Optimizer, Parameterization


OPTIMIZERS = {
    "adam": "eigengs_dr.fitting.parameterization:Adam",
    "adan": "eigengs_dr.fitting.parameterization:Adan",
}
"""Optimisers by name: each entry makes an `Optimizer` by ``entry(**settings)``."""

PARAMETERIZATIONS = {
    "scale_relative": "eigengs_dr.fitting.parameterization:SCALE_RELATIVE",
    "cholesky": "eigengs_dr.fitting.parameterization:CHOLESKY",
}
"""Parameterizations by name: the variables that an optimiser moves."""

MIN_PHASE_RATIO = 10
"""Smallest ratio of the steps of a descent to those of its first phase."""

MIN_FIRST_PHASE = 10
"""Fewest steps of a first phase. With 0.013 and 0.076 Gaussians a pixel, redistribution gains 0.07
and 0.6 dB in 100 steps (5 photos); in 60 steps, after 6 of them, it gains 0 and 0.3 dB, less than
more steps would in the same time."""


MAX_SURPLUS = 1.0
"""Gaussians of a long descent in addition to those asked for, relative to them. With 0.0127
Gaussians a pixel, 1,000 steps and 9 training photos, 0.5, 1 and 2 gain 0.23, 0.24 and 0.12 dB."""


@dataclass(frozen=True)
class Schedule:
    """The settings of a refinement.

    Attributes
    ----------
    optimizer : str
        A name in `OPTIMIZERS`.
    rates : dict of str to float
        Learning rate of every variable at the start. With "scale_relative" variables, the rates of
        mean and factor are relative to the size of the Gaussian; the unit of color is white.
    settings : dict, optional
        Other arguments of the optimiser.
    parameterization : str
        A name in `PARAMETERIZATIONS`.
    warm_up : int
        Steps over which the rates rise. The first steps of Adam have full length whatever the
        gradient; without a warm-up they would lose some decibels of the colour solve.
    decay : float
        Fraction of the rates at the end, after half a cosine.
    drift : float
        Sum of the largest rates after which the tile lists are built again. A build enlarges the
        Gaussians by what they may move until the next build, see `Parameterization.reach`.
    redistribute_after : int
        Most steps of the first phase, before redistribution; see `first_phase`.
    relocate_every : int
        Steps between two rounds of relocation, see `relocations`; 0 for no relocation.
    relocate_share : float
        Share of the Gaussians that move in a round.
    noise : float
        Strength of the perturbation in the first round, see `eigengs_dr.fitting.density_control`.
    surplus : float
        Share of Gaussians that are placed in addition and leave again, see `surplus_for`.
    rate_exponent : float
        Exponent by which the rates of means and shapes fall with the colour, see
        `eigengs_dr.fitting.descent.rate_scale_of`.
    """

    optimizer: str
    rates: dict[str, float]
    settings: Mapping[str, Any] = field(default_factory=dict)
    parameterization: str = "scale_relative"
    warm_up: int = 5
    decay: float = 0.03
    drift: float = 1.0
    redistribute_after: int = 20
    relocate_every: int = 0
    relocate_share: float = 0.1
    noise: float = 2.5
    surplus: float = MAX_SURPLUS
    rate_exponent: float = 0.0

    def make_optimizer(self) -> Optimizer:
        """Return the optimiser."""
        made: Optimizer = resolve_name(OPTIMIZERS[self.optimizer])(**self.settings)
        return made

    def variables(self) -> Parameterization:
        """Return the parameterization."""
        found: Parameterization = resolve_name(PARAMETERIZATIONS[self.parameterization])
        return found


def first_phase(schedule: Schedule, iterations: int) -> int:
    """Return the steps of the first phase, after which Gaussians are redistributed; 0 for none.

    Parameters
    ----------
    schedule : Schedule
    iterations : int
        Number of steps of the descent, with the first phase.

    Examples
    --------
    >>> schedule = Schedule("adam", {"color": 0.01}, redistribute_after=20)
    >>> [first_phase(schedule, steps) for steps in (99, 100, 150, 1000)]
    [0, 10, 15, 20]
    """
    steps = min(schedule.redistribute_after, iterations // MIN_PHASE_RATIO)
    return steps if steps >= min(MIN_FIRST_PHASE, schedule.redistribute_after) else 0


def lr_factor(schedule: Schedule, step: int, iterations: int, start: int = 0) -> float:
    """Return the factor of the learning rates at a step: a linear rise times half a cosine.

    The rise begins at the step `start`; earlier steps have the factor 0.
    """
    along = 0.5 * (1 + math.cos(math.pi * step / iterations))
    left = schedule.decay + (1 - schedule.decay) * along
    return left * min(1.0, max(0, step - start + 1) / max(1, schedule.warm_up))


RELOCATE_UNTIL, MIN_RELOCATIONS, MAX_RELOCATIONS = 0.65, 2, 72
"""The share of a descent that may relocate, and the numbers of rounds. In 100 steps more steps gain
more than rounds would, for the same time. With 5,000 steps, 72 rounds gain 0.07 and 0.1 dB over 40
(4 training photos, 0.0127 and 0.0254 Gaussians a pixel)."""


FULL_ROUNDS = 10
"""Number of rounds from which on noise and surplus have their full strength. A short descent does
not recover from more: with 300 steps and 0.076 Gaussians a pixel, a `Schedule.noise` of 4 costs 0.8
dB. With 0.0127 Gaussians a pixel, a surplus of 0.5 gains 0.24 dB there, and one of 1 0.18 dB."""


class Relocation(NamedTuple):
    """What moves in one round of relocation.

    Attributes
    ----------
    share : float
        Share of the Gaussians that leave their places, in [0, 1].
    noise : float
        Strength of the perturbation of all Gaussians, see `eigengs_dr.fitting.density_control`.
    seed : int
        Seed of the perturbation.
    dropped : int
        How many of those that leave are gone, even if the share says fewer. The others move to
        where the error is largest.
    """

    share: float
    noise: float = 0.0
    seed: int = 0
    dropped: int = 0


def relocations(schedule: Schedule, iterations: int, surplus: int = 0) -> dict[int, Relocation]:
    """Return what moves before which steps: evenly up to `RELOCATE_UNTIL`, with falling noise.

    Parameters
    ----------
    schedule : Schedule
    iterations : int
        Number of steps of the descent, without the first phase.
    surplus : int, optional
        Number of Gaussians to drop, about as many in each round.

    Examples
    --------
    >>> schedule = Schedule("adam", {"color": 0.01}, relocate_every=65, noise=4.0)
    >>> [(step, move.noise) for step, move in relocations(schedule, 1000).items()][:3]
    [(65, 4.0), (130, 3.6), (195, 3.2)]
    """
    if not schedule.relocate_every:
        return {}
    until = RELOCATE_UNTIL * iterations
    rounds = min(MAX_RELOCATIONS, int(until / schedule.relocate_every))
    if rounds < MIN_RELOCATIONS:
        return {}
    share, noise = schedule.relocate_share, schedule.noise * min(1, rounds / FULL_ROUNDS)
    left = [surplus * (rounds - k) // rounds for k in range(rounds + 1)]
    return {
        round(until * (k + 1) / rounds): Relocation(
            share, noise * (1 - k / rounds), seed=k, dropped=left[k] - left[k + 1]
        )
        for k in range(rounds)
    }


MAX_SURPLUS_DENSITY = 1 / 16
"""Most Gaussians a pixel of a set with a surplus. Denser sets do not converge in 1,000 steps. On 9
training photos, surpluses up to this density gain 0.24, 0.22 and 0.10 dB with 0.0127, 0.0254 and
0.045 Gaussians a pixel. With 0.076 Gaussians a pixel, a surplus of 0.3 costs 0.09 dB."""


def surplus_for(schedule: Schedule, count: int, pixels: int, iterations: int) -> int:
    """Return how many more Gaussians than asked for a descent has before its first relocation.

    Parameters
    ----------
    schedule : Schedule
    count, pixels : int
        Number of Gaussians asked for, and of pixels, both of one image.
    iterations : int
        Number of steps of the descent, without the first phase.

    Returns
    -------
    int
        `Schedule.surplus` times `count`, less in a short descent, up to `MAX_SURPLUS_DENSITY`.

    Examples
    --------
    >>> schedule = Schedule("adam", {"color": 0.01}, relocate_every=45)
    >>> [surplus_for(schedule, count, 256 * 256, 1000) for count in (1000, 3000, 5000)]
    [1000, 1096, 0]
    """
    share = schedule.surplus * min(1, len(relocations(schedule, iterations)) / FULL_ROUNDS)
    return max(0, min(int(share * count), int(MAX_SURPLUS_DENSITY * pixels) - count))


def next_build(
    schedule: Schedule, step: int, iterations: int, end: int | None = None
) -> tuple[int, dict[str, float]]:
    """Return how long the tile lists of a step last, and how far the variables move until then.

    Parameters
    ----------
    schedule : Schedule
    step, iterations : int
        The step that needs lists, and the number of steps of the descent.
    end : int, optional
        A step that needs no lists, or other ones; by default `iterations`.

    Returns
    -------
    stop : int
        The step that needs new lists, at most `end`.
    moves : dict of str to float
        Sums of the rates of every variable.
    """
    largest, total, stop = max(schedule.rates.values()), 0.0, step
    while stop < (iterations if end is None else end):
        factor = lr_factor(schedule, stop, iterations)
        if stop > step and largest * (total + factor) > schedule.drift:
            break
        total += factor
        stop += 1
    return stop, {name: rate * total for name, rate in schedule.rates.items()}

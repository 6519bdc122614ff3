"""How long and how fast an image is refined: rates, their decay, and when tile lists are built.

The registries of optimisers and parameterizations are here too. To add one, write one file in this
folder and one entry below: ``module:name``, which is imported when it is first used.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .parameterization import Parameterization

OPTIMIZERS = {
    "adam": "eigengs_dr.fitting.optimizers.adam:Adam",
    "adan": "eigengs_dr.fitting.optimizers.adan:Adan",
}
"""Optimisers by name: `drjit.opt.Optimizer` classes, made by ``Optimizer(lr, **settings)``."""

PARAMETERIZATIONS = {
    "scale_relative": "eigengs_dr.fitting.optimizers.parameterization:SCALE_RELATIVE",
    "cholesky": "eigengs_dr.fitting.optimizers.parameterization:CHOLESKY",
}
"""The variables that an optimiser moves, by name: each is a `Parameterization`."""

MIN_PHASE_RATIO = 10
"""Gaussians are redistributed only if the whole run has at least this many times the steps of its
first phase. Of 1,000 steps redistribution gains 0.8 dB, of 200 0.5, and of 100 nothing (5,000
Gaussians, ImageNet classes)."""


@dataclass(frozen=True)
class Schedule:
    """How an image is refined; the numbers of a preset.

    Attributes
    ----------
    optimizer : str
        A name in `OPTIMIZERS`.
    rates : dict of str to float
        Learning rate of every variable at the start. With "scale_relative" variables the rates of
        mean and factor are in sizes of the Gaussian, and the rate of color in units of white.
    settings : dict, optional
        More arguments of the optimiser.
    parameterization : str
        A name in `PARAMETERIZATIONS`.
    warm_up : int
        Steps over which the rates rise. Until its averages have settled, Adam takes steps of full
        length, which would leave the solved start by some decibels.
    decay : float
        Share of the rates that is left at the end of half a cosine.
    rebuild : int
        Steps between two builds of the tile lists.
    pad : float
        Pixels by which Gaussians are enlarged when lists are built, so that the lists last
        `rebuild` steps.
    redistribute_after : int
        Steps of the first phase, after which Gaussians may be redistributed; see `descend`.
    patience : int
        Stop when this many steps gained less than `least_gain`.
    least_gain : float
        Decibels.
    """

    optimizer: str
    rates: dict[str, float]
    settings: Mapping[str, Any] = field(default_factory=dict)
    parameterization: str = "scale_relative"
    warm_up: int = 5
    decay: float = 0.03
    rebuild: int = 4
    pad: float = 1.0
    redistribute_after: int = 20
    patience: int = 300
    least_gain: float = 0.01

    def make_optimizer(self) -> Any:
        """Return a new optimiser with a rate of 1 and no variables."""
        return resolve_name(OPTIMIZERS[self.optimizer])(1.0, **self.settings)

    def variables(self) -> Parameterization:
        """Return the variables that the optimiser moves."""
        found: Parameterization = resolve_name(PARAMETERIZATIONS[self.parameterization])
        return found


def lr_factor(schedule: Schedule, step: int, iterations: int) -> float:
    """Factor of the rates: a linear rise, then half a cosine."""
    along = 0.5 * (1 + math.cos(math.pi * step / iterations))
    left = schedule.decay + (1 - schedule.decay) * along
    return left * min(1.0, (step + 1) / max(1, schedule.warm_up))

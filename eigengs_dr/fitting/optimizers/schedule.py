"""The schedule of a refinement: learning rates, their decay, and the builds of tile lists.

This module also holds the registries of optimisers and parameterizations. To add one, write one
file in this folder and add one entry ``module:name`` below; its first use imports it.
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
"""Parameterizations by name: the variables that an optimiser moves."""

MIN_PHASE_RATIO = 10
"""Smallest ratio of the steps of the whole run to the steps of its first phase at which Gaussians
are redistributed. In 1,000 steps redistribution gains 0.8 dB, in 200 steps 0.5 dB, and in 100 steps
nothing (5,000 Gaussians, ImageNet classes)."""


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
    rebuild : int
        Steps between two builds of the tile lists.
    pad : float
        Pixels by which a build of the lists enlarges the Gaussians, so that the lists last
        `rebuild` steps.
    redistribute_after : int
        Steps of the first phase, before redistribution; see
        `eigengs_dr.fitting.optimizers.descent.descend`.
    patience : int
        Number of steps. A refinement stops if this many steps gain less than `least_gain`.
    least_gain : float
        Gain in dB, see `patience`.
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
        """Return a new optimiser with a learning rate of 1 and no variables."""
        return resolve_name(OPTIMIZERS[self.optimizer])(1.0, **self.settings)

    def variables(self) -> Parameterization:
        """Return the parameterization."""
        found: Parameterization = resolve_name(PARAMETERIZATIONS[self.parameterization])
        return found


def lr_factor(schedule: Schedule, step: int, iterations: int) -> float:
    """Return the factor of the learning rates at a step: a linear rise times half a cosine."""
    along = 0.5 * (1 + math.cos(math.pi * step / iterations))
    left = schedule.decay + (1 - schedule.decay) * along
    return left * min(1.0, (step + 1) / max(1, schedule.warm_up))

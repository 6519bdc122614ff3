"""How long and how fast an image is refined: rates, their decay, and when tile lists are built."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from .parameterization import SCALE_RELATIVE, Parameterization

MIN_PHASE_RATIO = 10
"""Splats are placed anew only where so many times as many steps are to be taken as before it: of
1,000 steps that gains 0.8 dB, of 200 0.5, and of 100 nothing (5,000 splats, ImageNet classes)."""


@dataclass(frozen=True)
class Schedule:
    """How an image is refined; the numbers of a preset.

    Attributes
    ----------
    optimizer : callable
        ``optimizer(lr) -> drjit.opt.Optimizer``.
    rates : dict of str to float
        Learning rate of every coordinate at the start; in `SCALE_RELATIVE` coordinates of mean and
        factor (in sizes of the splat) and color (1 is white).
    coordinates : Coordinates
        The variables that the optimiser moves.
    warm_up : int
        Steps over which the rates rise: until their averages have settled, steps of Adam are all
        of full length and would leave the solved start by some decibels.
    decay : float
        What is left of the rates at the end, along half a cosine.
    rebuild : int
        Steps between two builds of the tile lists.
    pad : float
        Pixels by which splats are enlarged when lists are built, so that they last `rebuild` steps.
    redistribute_after : int
        Steps after which splats may be placed anew, see `descend`.
    patience : int
        Stop when this many steps gained less than `least_gain`.
    least_gain : float
        Decibels.
    """

    optimizer: Callable[[float], Any]
    rates: dict[str, float]
    coordinates: Parameterization = SCALE_RELATIVE
    warm_up: int = 5
    decay: float = 0.03
    rebuild: int = 4
    pad: float = 1.0
    redistribute_after: int = 20
    patience: int = 300
    least_gain: float = 0.01


def lr_factor(schedule: Schedule, step: int, iterations: int) -> float:
    """Factor of the rates: a linear rise, then half a cosine."""
    along = 0.5 * (1 + math.cos(math.pi * step / iterations))
    left = schedule.decay + (1 - schedule.decay) * along
    return left * min(1.0, (step + 1) / max(1, schedule.warm_up))

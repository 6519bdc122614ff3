"""The named methods that `fit` and the benchmarks compare."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from drjit.opt import Adam

from .adan import Adan
from .coordinates import CHOLESKY
from .refine import Schedule


@dataclass(frozen=True)
class Preset:
    """A method: where splats start, whether colours are solved for, how all is refined.

    Attributes
    ----------
    init : str
        What ``init="auto"`` stands for.
    solves : bool
        Whether the colour solve runs before refinement; else colours are drawn from [0, 1] and the
        background is black.
    schedule : Schedule
    """

    init: str
    solves: bool
    schedule: Schedule


PRESETS = {
    "default": Preset(
        init="adaptive",
        solves=True,
        schedule=Schedule(
            optimizer=partial(Adam, beta_1=0.9, beta_2=0.9, epsilon=1e-12),
            rates={"mean": 0.12, "factor": 0.12, "color": 0.015},
        ),
    ),
    # GaussianImage's recipe: one rate for all, no colour solve; its rates are halved only after
    # 20,000 steps, which no run here reaches.
    "gaussianimage": Preset(
        init="random",
        solves=False,
        schedule=Schedule(
            optimizer=Adan,
            rates={"mean": 1e-3, "cholesky": 1e-3, "color": 1e-3},
            coordinates=CHOLESKY,
            decay=1.0,
            warm_up=0,
            patience=10_000,
        ),
    ),
}
"""Presets by name."""

"""The named methods that `fit` and the benchmarks compare."""

from __future__ import annotations

from dataclasses import dataclass

from .optimizers.schedule import Schedule


@dataclass(frozen=True)
class Preset:
    """A method: where splats start, whether colours are solved for, how all is refined.

    Attributes
    ----------
    init : str
        What ``init="auto"`` stands for.
    solves : bool
        Whether colours are the best ones for the shapes before refinement starts. Else those of the
        eigenbasis are projected, and all others drawn from [0, 1] with a black background.
    schedule : Schedule
    mean : {"gaussians", "dense"}
        With an eigenbasis, whether Gaussians make the mean image too or it is kept as pixels.
    """

    init: str
    solves: bool
    schedule: Schedule
    mean: str = "gaussians"


# GaussianImage's recipe: one rate for all; it is halved only after 20,000 steps, which no run here
# reaches.
_ONE_RATE = Schedule(
    optimizer="adan",
    rates={"mean": 1e-3, "cholesky": 1e-3, "color": 1e-3},
    parameterization="cholesky",
    decay=1.0,
    warm_up=0,
    patience=10_000,
)

PRESETS = {
    "default": Preset(
        init="adaptive",
        solves=True,
        schedule=Schedule(
            optimizer="adam",
            settings={"beta_1": 0.9, "beta_2": 0.9, "epsilon": 1e-12},
            rates={"mean": 0.12, "factor": 0.12, "color": 0.015},
        ),
    ),
    "gaussianimage": Preset(init="random", solves=False, schedule=_ONE_RATE),
    # The paper's: the same descent, from the projection on the eigenbasis.
    "eigengs": Preset(init="eigen", solves=False, schedule=_ONE_RATE, mean="dense"),
}
"""Presets by name."""

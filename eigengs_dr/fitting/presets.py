"""The named methods of `fit`."""

from __future__ import annotations

from dataclasses import dataclass

from .optimizers.schedule import Schedule


@dataclass(frozen=True)
class Preset:
    """A method: the initialiser, the start of the colours and the schedule of the refinement.

    Attributes
    ----------
    init : str
        Initialiser for ``init="auto"``.
    solves : bool
        Whether a solve finds the best colours for the shapes before refinement. Without a solve,
        an eigenbasis gives the colours by projection; other initialisers draw them from [0, 1] on
        a black background.
    schedule : Schedule
        Schedule of the refinement.
    mean : {"gaussians", "dense"}
        With an eigenbasis: "gaussians" if the Gaussians include the mean image, "dense" if the
        mean image stays pixels.
    """

    init: str
    solves: bool
    schedule: Schedule
    mean: str = "gaussians"


# GaussianImage has one learning rate for all variables. It halves the rate after 20,000 steps,
# which no fit here reaches.
_ONE_RATE = Schedule(
    optimizer="adan",
    rates={"mean": 1e-3, "cholesky": 1e-3, "color": 1e-3},
    parameterization="cholesky",
    decay=1.0,
    warm_up=0,
    drift=4e-3,
    patience=10_000,
)

PRESETS = {
    "default": Preset(
        init="adaptive",
        solves=True,
        schedule=Schedule(
            optimizer="adam",
            settings={"beta_1": 0.9, "beta_2": 0.9, "epsilon": 1e-12},
            rates={"mean": 0.28, "factor": 0.22, "color": 0.0115},
            relocate_every=45,
            agility=0.5,
        ),
    ),
    "gaussianimage": Preset(init="random", solves=False, schedule=_ONE_RATE),
    # EigenGS's paper descends as GaussianImage does, from the projection on the eigenbasis.
    "eigengs": Preset(init="eigen", solves=False, schedule=_ONE_RATE, mean="dense"),
}
"""Presets by name."""

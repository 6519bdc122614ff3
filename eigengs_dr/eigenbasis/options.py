"""Everything that decides a training beside the images, checked once; a model from a basis."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..backend.executor import executor_for
from ..image.color import BASIS_SPACES, check_size
from .components.solve import State, fit_components, split_reason, wants_split
from .pca.basis import Eigenbasis, check_components
from .pca.truncation import check_target

STEPS = {"default": 0, "eigengs": 15_000}
"""Presets, and the steps of training that each takes if none are given."""


@dataclass(frozen=True)
class TrainOptions:
    """Options of a training; `eigengs_dr.EigenGS.fit` takes a part of them.

    Attributes
    ----------
    size : (int, int)
        Width and height in pixels.
    components : int or tuple of 3 ints
        Largest number of components of each channel.
    energy : float or None
        Keep the fewest components that hold this share of a channel's variance.
    target_psnr : float or None
        Keep the fewest components whose PCA has this mean PSNR, in dB, on the images held out; see
        `eigengs_dr.eigenbasis.pca.truncation.TruncationCurve`.
    gaussians, frequency_aware, preset, iterations, seed
        See `eigengs_dr.EigenGS.fit`.
    space : {"ycbcr", "rgb"}
        Space of the components.

    Raises
    ------
    ValueError
        If an option is out of range, or two of them exclude each other; one line that names it.
    """

    size: tuple[int, int] = (256, 256)
    components: int | tuple[int, int, int] = 300
    energy: float | None = None
    target_psnr: float | None = None
    gaussians: int = 5000
    frequency_aware: bool | str = "auto"
    preset: str = "default"
    iterations: int | None = None
    space: str = "ycbcr"
    seed: int = 0

    def __post_init__(self) -> None:
        check_components(self.components, self.energy)
        if self.target_psnr is not None:
            check_target(self.target_psnr)
            if self.energy is not None:
                raise ValueError(
                    "energy and target_psnr both choose the components; give one of them"
                )
        if self.space not in BASIS_SPACES:
            raise ValueError(
                f"space {self.space!r} is unknown; use one of {', '.join(BASIS_SPACES)}"
            )
        if self.preset not in STEPS:
            raise ValueError(f"preset {self.preset!r} is unknown; use one of {', '.join(STEPS)}")
        counts = {
            "gaussians": self.gaussians,
            "seed": self.seed,
            "iterations": self.training_steps,
        }
        for name, number in counts.items():
            if not isinstance(number, (int, np.integer)) or number < 0:
                raise ValueError(f"{name} is {number!r}; it must be at least 0, and whole")
        width, height = check_size(self.size)
        if not 1 <= self.gaussians <= width * height:
            raise ValueError(
                f"gaussians is {self.gaussians}; a basis of {width}x{height} takes 1 to "
                f"{width * height}"
            )
        if self.preset == "eigengs" and self.training_steps < 1:
            raise ValueError("iterations is 0; preset 'eigengs' needs training, so give at least 1")
        if not isinstance(self.frequency_aware, bool) and self.frequency_aware != "auto":
            raise ValueError(
                f"frequency_aware is {self.frequency_aware!r}; use 'auto', True or False"
            )

    @property
    def training_steps(self) -> int:
        """The number of steps: as given, or that of the preset."""
        return STEPS[self.preset] if self.iterations is None else self.iterations


TrainProgress = Callable[[int, int, dict[str, Any]], None]
"""``progress(step, steps, {})``"""


def fit_model(
    basis: Eigenbasis,
    options: TrainOptions,
    backend: str | None = None,
    progress: TrainProgress | None = None,
    states: list[State] | None = None,
    save: Callable[[list[State]], None] = lambda states: None,
    client: Any = None,
) -> dict[str, Any]:
    """Decide on the split, and fit Gaussians and weights to all components of a basis.

    Parameters
    ----------
    basis : Eigenbasis
    options : TrainOptions
        Of which those that `eigengs_dr.EigenGS.fit` takes count.
    backend : {"llvm", "cuda"}, optional
    progress : callable, optional
        ``progress(step, steps, {})`` after every round of training.
    states : list of dict, optional
        Resume from the last argument of `save`.
    save : callable, optional
        ``save(states)`` after `progress`; an error that it raises ends the work.
    client : distributed.Client, optional
        See `eigengs_dr.EigenGS.fit`.

    Returns
    -------
    dict of str to object
        Arguments of `eigengs_dr.EigenGS`.
    """
    count, wanted = options.gaussians, options.frequency_aware
    split, figures = wants_split(basis, count, wanted, backend)
    total = options.training_steps * (2 if split else 1)

    def report(states: list[State]) -> None:
        if progress:
            progress(sum(int(state["step"]) for state in states), total, {})
        save(states)

    fitted = fit_components(
        basis,
        count,
        split,
        options.preset,
        options.training_steps,
        options.seed,
        backend,
        states,
        report,
        executor_for(client),
    )
    return {
        "gaussians": fitted.gaussians,
        "weights": fitted.weights,
        "eigenvalues": basis.eigenvalues,
        "mean_image": basis.mean,
        "low": fitted.low,
        "low_components": fitted.low_components,
        "split_reason": split_reason(basis, count, wanted, figures),
        "variance": basis.variance,
        "figures": {**fitted.figures, **figures},
    }

"""The fit of a model to an eigenbasis, for `eigengs_dr.EigenGS.fit` and for a training."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..backend.executor import executor_for
from .components.solve import State, fit_components
from .components.split import split_reason, wants_split
from .options import TrainOptions
from .pca.basis import Eigenbasis

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

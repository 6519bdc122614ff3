"""The fit of shared Gaussians to an eigenbasis: shapes, then weights for each component."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...backend.doors import door
from ...gaussian.gaussians import Gaussians, concatenate, with_colors
from ...image.metrics import psnr_from_mse
from ...image.space import space_of
from ...paper.joint_training import State, joint_shapes, joint_weights, train_jointly
from ..normal_equations import BATCH, NormalEquations, squared_norms
from ..options import TrainOptions
from ..pca.basis import Eigenbasis
from .bands import Planes, frequency_bands, low_component_count, on_grid


@door
def fit_model(
    basis: Eigenbasis,
    options: TrainOptions,
    backend: str | None = None,
    progress: Callable[[int, int, dict[str, Any]], None] | None = None,
    states: list[State] | None = None,
    save: Callable[[list[State]], None] = lambda states: None,
) -> dict[str, Any]:
    """Fit one set of Gaussians and its weights to all components of a basis.

    Parameters
    ----------
    basis : Eigenbasis
    options : TrainOptions
        Only the options of `eigengs_dr.EigenGS.fit` are used.
    backend : {"llvm", "cuda"}, optional
    progress : callable, optional
        ``progress(step, steps, {})`` is called after every round of training.
    states : list of dict, optional
        Resume from the last argument of `save`: the state of each band.
    save : callable, optional
        ``save(states)`` is called after `progress`; an error that it raises ends the training.

    Returns
    -------
    dict of str to object
        Arguments of `eigengs_dr.EigenGS`. The figures are ``psnr_components``, the PSNR of the
        components in dB, weighted by their variances; ``shape_seconds`` and ``weight_seconds``, the
        times of the training and of the rest.

    Raises
    ------
    ValueError
        If the preset is "eigengs" and the basis has no components.
    """
    bands = frequency_bands(basis, options.gaussians, options.frequency_aware)
    split = len(bands) > 1
    steps, joint = options.training_steps, options.preset == "eigengs"
    states = list(states or [])
    started = time.perf_counter()
    for i, band in enumerate(bands if joint else ()):
        previous = states[i] if i < len(states) else None
        for state in train_jointly(band, options.seed + i, steps, backend, previous):
            states[i:] = [state]
            if progress:
                done = sum(int(state["step"]) for state in states)
                progress(done, steps * len(bands), {})
            save(states)
    trained = time.perf_counter()
    shapes: list[Gaussians] = []
    weights: list[list[Planes]] = []  # of each band, in the components of the band
    for i, band in enumerate(bands):
        shapes.append(joint_shapes(states[i], band, backend) if joint else on_grid(band, backend))
        if joint:
            weights.append(joint_weights(states[i], band))
        elif split:
            band_equations = NormalEquations(shapes[-1])
            weights.append([find_weights(band_equations, planes)[0] for planes in band.components])
    known: Sequence[Planes | None] = weights[0] if weights else [None] * len(basis.components)
    if split:
        known = [_join_weights(low, high) for low, high in zip(*weights, strict=True)]
    gaussians, low = concatenate(shapes), bands[0].number if split else 0
    equations = NormalEquations(gaussians, low)
    fitted = [find_weights(equations, *pair) for pair in zip(basis.components, known, strict=True)]
    mean, _ = find_weights(equations, basis.mean)
    pairs = zip(basis.eigenvalues, fitted, strict=True)
    error = sum(float(values @ errors) for values, (_, errors) in pairs)
    return {
        "gaussians": with_colors(gaussians, mean.T, space_of(basis.space)),
        "weights": tuple(rows for rows, _ in fitted),
        "eigenvalues": basis.eigenvalues,
        "mean_image": basis.mean,
        "low": low,
        "low_components": low_component_count(basis) if split else 0,
        "variance": basis.variance,
        "figures": {
            "shape_seconds": trained - started,
            "weight_seconds": time.perf_counter() - trained,
            "psnr_components": psnr_from_mse(error / basis.mean.size),
        },
    }


def find_weights(
    equations: NormalEquations, planes: Planes, known: Planes | None = None
) -> tuple[Planes, NDArray[np.float64]]:
    """Compute the best weights of Gaussians in the components of a channel.

    Parameters
    ----------
    equations : NormalEquations
    planes : ndarray of float32, shape (k, H, W)
    known : ndarray of float32, shape (k, N + 1), optional
        The weights, if only the errors are needed.

    Returns
    -------
    weights : ndarray of float32, shape (k, N + 1)
        See `eigengs_dr.EigenGS`.
    errors : ndarray of float64, shape (k,)
        Squared distance between each component and its rendering, summed over pixels.
    """
    weights = np.empty((len(planes), equations.count + 1), np.float32)
    errors = np.empty(len(planes))
    for first in range(0, len(planes), BATCH):
        rows = slice(first, first + BATCH)
        correlations = equations.correlate(planes[rows])
        weights[rows] = equations.solve(correlations).T if known is None else known[rows]
        coefficients = weights[rows].T.astype(np.float64)
        errors[rows] = equations.error(coefficients, correlations, squared_norms(planes[rows]))
    return weights, errors


def _join_weights(low: Planes, high: Planes) -> Planes:
    """Combine the weights of both bands in a channel; cross weights are 0."""
    count, number = len(low), low.shape[1] - 1
    joined = np.zeros((count + len(high), number + high.shape[1]), np.float32)
    joined[:count, :number], joined[:count, -1] = low[:, :-1], low[:, -1]
    joined[count:, number:] = high
    return joined

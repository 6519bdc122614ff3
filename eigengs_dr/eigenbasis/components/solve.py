"""The fit of shared Gaussians to an eigenbasis: shapes, and a weight for each component."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...backend.arrays import types_of, upload_rows
from ...backend.executor import Executor, executor_for
from ...gaussian.gaussians import Gaussians, concatenate
from ...image.metrics import psnr_from_mse
from ..pca.basis import Eigenbasis
from .joint_state import JointState
from .joint_training import train_jointly
from .shape_training import on_grid, shapes_of, train_shapes
from .split import FrequencyBand, frequency_bands, low_component_count
from .weights import SharedShapes, Weighted, find_weights

Planes = NDArray[np.float32]
State = dict[str, NDArray[Any]]


class Band(NamedTuple):
    """Gaussians of a band, with their weights in its components if the training found them."""

    gaussians: Gaussians
    weights: tuple[Planes, ...] = ()


class ComponentFit(NamedTuple):
    """Gaussians that render an eigenbasis.

    Attributes
    ----------
    gaussians, weights, low, low_components
        See `eigengs_dr.EigenGS`.
    figures : dict of str to float
        ``psnr_components``: PSNR of the components, weighted by their variances, in dB;
        ``psnr_untrained``: the same PSNR before the training of the shapes, if there is one;
        ``shape_seconds``, ``weight_seconds``: time of the training, and of the rest.
    """

    gaussians: Gaussians
    weights: tuple[Planes, ...]
    low: int
    low_components: int
    figures: dict[str, float]


def fit_components(
    basis: Eigenbasis,
    count: int,
    split: bool,
    method: str,
    steps: int,
    seed: int,
    backend: str | None = None,
    states: list[State] | None = None,
    save: Callable[[list[State]], None] = lambda states: None,
    executor: Executor | None = None,
) -> ComponentFit:
    """Place and train one set of Gaussians for all components, and find their weights.

    Parameters
    ----------
    basis : Eigenbasis
    count : int
        Number of Gaussians, at most one per pixel; at least 2 for the split.
    split : bool
        Whether a share `LOW_SHARE` of the Gaussians serves the first components alone, and the
        other Gaussians the other components.
    method : {"default", "eigengs"}
        "default" trains the shapes on random combinations of components and solves for the
        weights; "eigengs" trains shapes and weights together, as the paper does.
    steps : int
        Training steps for each band.
    seed : int
    backend : {"llvm", "cuda"}, optional
    states : list of dict, optional
        Resume from the last argument of `save`.
    save : callable, optional
        ``save(states)`` after every round of training; an error that it raises ends the work.
    executor : Executor, optional
        Where the weights are solved for; this process by default.

    Raises
    ------
    ValueError
        If the method is "eigengs" and the basis has no components.
    ClusterError
        If the cluster is lost.
    """
    if method == "eigengs" and not any(map(len, basis.components)):
        raise ValueError("the images give no components to train on; use preset 'default'")
    started, executor = time.perf_counter(), executor or executor_for()
    sides, states = frequency_bands(basis, count, split), list(states or [])
    train, result = METHODS_BY_PRESET[method]
    for i, side in enumerate(sides):
        previous = states[i] if i < len(states) else None
        for state in train(side, seed + i, steps, backend, previous):
            states[i:] = [state]
            save(states)
    trained = time.perf_counter()
    gaussians, weighted = _assemble(basis, states, sides, result, backend, executor)
    figures = {
        "shape_seconds": trained - started,
        "weight_seconds": time.perf_counter() - trained,
        "psnr_components": psnr_components(basis, weighted.errors),
    }
    if method == "default" and steps:
        size = (basis.width, basis.height)
        grids = [on_grid(size, side.splats) for side in sides]
        _, untrained = _assemble(basis, grids, sides, result, backend, executor)
        figures["psnr_untrained"] = psnr_components(basis, untrained.errors)
    return ComponentFit(
        gaussians=with_colors(gaussians, weighted.weights[-1].T, basis.space),
        weights=weighted.weights[:-1],
        low=sides[0].splats if split else 0,
        low_components=low_component_count(basis) if split else 0,
        figures=figures,
    )


def _assemble(
    basis: Eigenbasis,
    states: list[State],
    sides: list[FrequencyBand],
    result: Callable[..., Band],
    backend: str | None,
    executor: Executor,
) -> tuple[Gaussians, Weighted]:
    """Return the Gaussians of all bands, and their weights in the components and the mean."""
    bands = [result(state, side, backend) for state, side in zip(states, sides, strict=True)]
    (gaussians, known), low = bands[0], 0
    if len(bands) > 1:
        weights = []
        for band, side in zip(bands, sides, strict=True):
            shapes = SharedShapes.of(band.gaussians, backend=backend)
            alone = band.weights or find_weights(shapes, side.components, executor).weights
            weights.append(alone)
        known, low = _join_weights(*weights), sides[0].splats
        gaussians = concatenate([band.gaussians for band in bands])
    shapes = SharedShapes.of(gaussians, low, backend)
    return gaussians, find_weights(shapes, (*basis.components, basis.mean), executor, known)


def psnr_components(basis: Eigenbasis, errors: tuple[NDArray[np.float64], ...]) -> float:
    """Return the PSNR of ``sum_j lambda_j |Psi~_j - Psi_j|^2`` per pixel and channel, in dB.

    Parameters
    ----------
    basis : Eigenbasis
    errors : tuple of ndarrays, shape (k_c,)
        See `Weighted`; those after the C channels of the basis are ignored.
    """
    pairs = zip(basis.eigenvalues, errors, strict=False)
    return psnr_from_mse(float(sum(values @ error for values, error in pairs)) / basis.mean.size)


def _train_shapes(
    side: FrequencyBand, seed: int, steps: int, backend: str | None, state: State | None
) -> Iterator[State]:
    return train_shapes(
        side.components, side.eigenvalues, side.splats, seed, steps, backend=backend, state=state
    )


def _shapes_alone(state: State, side: FrequencyBand, backend: str | None) -> Band:
    """Return the shapes of a state, whose weights are solved for."""
    height, width = side.components[0].shape[1:]
    return Band(shapes_of(state, (width, height), len(side.components), backend))


def _train_jointly(
    side: FrequencyBand, seed: int, steps: int, backend: str | None, state: State | None
) -> Iterator[State]:
    start = JointState.from_arrays(state) if state else None
    for current in train_jointly(
        side.components, side.splats, seed, steps, backend=backend, state=start
    ):
        yield current.arrays()


def _weights_of(state: State, side: FrequencyBand, backend: str | None) -> Band:
    """Return the shapes and weights of a state; colours are 0, with all channels."""
    joint = JointState.from_arrays(state)
    blank = np.zeros((side.splats + 1, len(side.components)))
    return Band(with_colors(joint.gaussians(backend), blank, "data"), joint.weights())


METHODS_BY_PRESET = {
    "default": (_train_shapes, _shapes_alone),
    "eigengs": (_train_jointly, _weights_of),
}
"""Functions of each preset: one trains a band step by step, one turns its state into a `Band`."""


def _join_weights(first: tuple[Planes, ...], second: tuple[Planes, ...]) -> tuple[Planes, ...]:
    """Join the weights of both bands; weights between the bands are 0."""
    result = []
    for low, high in zip(first, second, strict=True):
        right, left = high.shape[1] - 1, low.shape[1] - 1
        above = np.hstack([low[:, :-1], np.zeros((len(low), right), np.float32), low[:, -1:]])
        below = np.hstack([np.zeros((len(high), left), np.float32), high])
        result.append(np.vstack([above, below]))
    return tuple(result)


def with_colors(gaussians: Gaussians, coefficients: NDArray[np.float64], space: str) -> Gaussians:
    """Return Gaussians of the same shapes with other colours.

    Parameters
    ----------
    gaussians : Gaussians
    coefficients : ndarray, shape (N + 1, C)
        Colours of the Gaussians; the last row is the background.
    space : str
        Colour space of the channels.
    """
    types = types_of(gaussians.mean)
    rows = coefficients.astype(np.float32).T
    uploaded = upload_rows(types.Float, [*rows[:, :-1], *rows[:, -1:]])
    return replace(
        gaussians,
        color=types.FloatX(uploaded[: len(rows)]),
        background=types.FloatX(uploaded[len(rows) :]),
        space=space,
    )

"""The fit of shared Gaussians to an eigenbasis: shapes, and a weight for each component.

Weights are found group by group, here or by workers. The frequency-aware split says which Gaussians
serve which components, and whether to split.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...backend.executor import Executor, completed, executor_for
from ...backend.recording import exclusive
from ...fitting.solvers.normal_equations import BATCH, NormalEquations, squared_norms
from ...gaussian.file import SetData
from ...gaussian.gaussians import Gaussians, concatenate, with_colors
from ...image.color import to_planes
from ...image.metrics import psnr_from_mse
from ..pca.basis import Eigenbasis
from .joint_training import JointState, train_jointly
from .shape_training import on_grid, shapes_of, train_shapes

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
        grids = [on_grid(size, side.number) for side in sides]
        _, untrained = _assemble(basis, grids, sides, result, backend, executor)
        figures["psnr_untrained"] = psnr_components(basis, untrained.errors)
    return ComponentFit(
        gaussians=with_colors(gaussians, weighted.weights[-1].T, basis.space),
        weights=weighted.weights[:-1],
        low=sides[0].number if split else 0,
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
        known, low = _join_weights(*weights), sides[0].number
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
        side.components, side.eigenvalues, side.number, seed, steps, backend=backend, state=state
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
        side.components, side.number, seed, steps, backend=backend, state=start
    ):
        yield current.arrays()


def _weights_of(state: State, side: FrequencyBand, backend: str | None) -> Band:
    """Return the shapes and weights of a state; colours are 0, with all channels."""
    joint = JointState.from_arrays(state)
    blank = np.zeros((side.number + 1, len(side.components)))
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


@dataclass(frozen=True, eq=False)
class SharedShapes:
    """Gaussians whose colours are solved for, as arrays, which travel to workers.

    Attributes
    ----------
    data : SetData
    low : int
        See `eigengs_dr.fitting.solvers.normal_equations.NormalEquations`.
    backend : str or None
    """

    data: SetData
    low: int = 0
    backend: str | None = None

    @classmethod
    def of(cls, gaussians: Gaussians, low: int = 0, backend: str | None = None) -> SharedShapes:
        """Take the shapes of Gaussians."""
        return cls(gaussians.data(), low, backend)

    @cached_property
    def equations(self) -> NormalEquations:
        """The factorised equations; they are built once in a process."""
        return NormalEquations(Gaussians.from_data(self.data, self.backend), self.low)

    def __getstate__(self) -> dict[str, Any]:
        """Leave the equations here: arrays of Dr.Jit do not travel."""
        return {key: value for key, value in self.__dict__.items() if key != "equations"}


class Group(NamedTuple):
    """A task: some components of one channel (m, H, W), and their weights (m, N + 1) if known.

    The place is the channel, and which of its components they are.
    """

    place: tuple[int, slice]
    planes: Planes
    weights: Planes | None


class Weighted(NamedTuple):
    """Weights of components, and the errors of what they render.

    Attributes
    ----------
    weights : tuple of C ndarrays of float32, shape (k_c, N + 1)
        See `eigengs_dr.EigenGS`.
    errors : tuple of C ndarrays of float64, shape (k_c,)
        Squared distance of each component to its rendering, summed over pixels.
    """

    weights: tuple[Planes, ...]
    errors: tuple[NDArray[np.float64], ...]


def find_weights(
    shapes: SharedShapes,
    components: tuple[Planes, ...],
    executor: Executor,
    known: Sequence[Planes] = (),
) -> Weighted:
    """Find the best weights of Gaussians in components, and their errors, by an executor.

    Each process factorises the equations once. The groups do not depend on the workers; so neither
    does a bit of the result, if all have one number of BLAS threads. With another number, products
    round differently, and weights differ by up to 2e-5 of the largest.

    Parameters
    ----------
    shapes : SharedShapes
    components : tuple of C ndarrays of float32, shape (k_c, H, W)
        The components of each channel; the mean image may follow as one channel more.
    executor : Executor
    known : sequence of up to C ndarrays of float32, shape (k_c, N + 1), optional
        Weights of the first channels, if they are known; only their errors are computed.

    Raises
    ------
    ClusterError
        If the cluster is lost, or a task ends its worker again and again.
    """
    columns = len(shapes.data.arrays["mean"]) + 1
    found = [np.empty((len(planes), columns), np.float32) for planes in components]
    errors = [np.empty(len(planes)) for planes in components]
    places = [(c, rows) for c, planes in enumerate(components) for rows in _groups(len(planes))]
    tasks = (
        Group((c, rows), components[c][rows], known[c][rows] if c < len(known) else None)
        for c, rows in places
    )
    with closing(completed(executor, solve_group, tasks, shapes)) as ended:
        for group, (solved, error) in ended:
            c, rows = group.place
            found[c][rows], errors[c][rows] = solved, error
    return Weighted(tuple(found), tuple(errors))


@exclusive()
def solve_group(group: Group, shapes: SharedShapes) -> tuple[Planes, NDArray[np.float64]]:
    """Return weights and errors of a group; this function runs on a worker."""
    equations = shapes.equations
    correlations = equations.correlate(group.planes)
    weights = group.weights
    if weights is None:
        weights = equations.solve(correlations).T.astype(np.float32)
    norms = squared_norms(group.planes)
    return weights, equations.error(weights.T.astype(np.float64), correlations, norms)


def _groups(count: int) -> Iterator[slice]:
    for first in range(0, count, BATCH):
        yield slice(first, min(first + BATCH, count))


LOW_SHARE = 0.1
"""Share of the Gaussians that serve the low frequencies in a split (the paper)."""


LOW_COMPONENTS = 50
"""Number of components of each channel that are low frequencies (the authors' code); with fewer
than 100 components, it is half of them."""


SPLIT_FROM = 512
"""Smallest longer side, in pixels, at which "auto" considers the split. In the paper, the split
costs 0.4 to 0.8 dB at 256 pixels and gains 1 dB at 512."""


SPLIT_COST = 0.2
"""Largest loss of PSNR, in dB of exact colours, at which "auto" still splits."""


class FrequencyBand(NamedTuple):
    """A number of Gaussians and the components that they serve: all, or one side of the split."""

    number: int
    components: tuple[Planes, ...]
    eigenvalues: tuple[NDArray[np.float64], ...]


def wants_split(
    basis: Eigenbasis, count: int, frequency_aware: bool | str, backend: str | None = None
) -> tuple[bool, dict[str, float]]:
    """Decide on the frequency-aware split; "auto" measures it for large images.

    From `SPLIT_FROM` pixels on, "auto" fits exact colours to the example images, with and without
    the split, and compares the PSNR. It accepts a loss of `SPLIT_COST`, because without coarse
    Gaussians, small Gaussians must render the low frequencies (the paper's "penny-round tiles").

    Returns
    -------
    bool
        Whether to split.
    dict of str to float
        ``psnr_whole`` and ``psnr_split`` in dB; empty without a measurement.
    """
    if count < 2 or low_component_count(basis) < 1:
        return False, {}
    if isinstance(frequency_aware, bool):
        return frequency_aware, {}
    if max(basis.width, basis.height) < SPLIT_FROM or not len(basis.examples):
        return False, {}
    images = np.stack([to_planes(image, basis.space) for image in basis.examples])
    planes = images.reshape(-1, basis.height, basis.width)
    figures = {}
    for name, split in (("psnr_whole", False), ("psnr_split", True)):
        counts = [side.number for side in frequency_bands(basis, count, split)]
        size = (basis.width, basis.height)
        sets = [shapes_of(on_grid(size, n), size, 1, backend) for n in counts]
        equations = NormalEquations(concatenate(sets), counts[0] if split else 0)
        correlations = equations.correlate(planes)
        error = equations.error(equations.solve(correlations), correlations, squared_norms(planes))
        figures[name] = psnr_from_mse(float(error.mean()) / (basis.width * basis.height))
    return figures["psnr_split"] > figures["psnr_whole"] - SPLIT_COST, figures


def split_reason(
    basis: Eigenbasis, count: int, frequency_aware: bool | str, figures: dict[str, float]
) -> str:
    """Return the reason for the decision of `wants_split` in under 64 characters."""
    if count < 2 or low_component_count(basis) < 1:
        return "too few Gaussians or components to split"
    if isinstance(frequency_aware, bool):
        return "frequency_aware is set"
    if figures:
        whole, split = figures["psnr_whole"], figures["psnr_split"]
        return f"whole {whole:.2f} dB, split {split:.2f} dB, may cost {SPLIT_COST:g}"
    if (side := max(basis.width, basis.height)) < SPLIT_FROM:
        return f"{side} pixels a side; auto measures from {SPLIT_FROM} on"
    return "no training images to compare on"


def low_component_count(basis: Eigenbasis) -> int:
    """Return the number of components of each channel that are low frequencies."""
    return min(LOW_COMPONENTS, max(map(len, basis.components)) // 2)


def frequency_bands(basis: Eigenbasis, count: int, split: bool) -> list[FrequencyBand]:
    """Divide the Gaussians and components into bands, low frequencies first."""
    if not split:
        return [FrequencyBand(count, basis.components, basis.eigenvalues)]
    low = max(1, round(LOW_SHARE * count))

    def part(number: int, rows: slice) -> FrequencyBand:
        planes = tuple(c[rows] for c in basis.components)
        return FrequencyBand(number, planes, tuple(e[rows] for e in basis.eigenvalues))

    first = low_component_count(basis)
    return [part(low, slice(first)), part(count - low, slice(first, None))]

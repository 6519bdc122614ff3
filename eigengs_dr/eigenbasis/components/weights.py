"""The weights of shared Gaussians in components, group by group, here or by workers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...backend.executor import Executor, completed
from ...backend.recording import exclusive
from ...fitting.solvers.normal_equations import BATCH, NormalEquations, squared_norms
from ...gaussian.file import SetData
from ...gaussian.gaussians import Gaussians

Planes = NDArray[np.float32]


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
    """A task: some components of one channel (m, H, W), and their weights (m, N + 1) if known."""

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
        Group(components[c][rows], known[c][rows] if c < len(known) else None) for c, rows in places
    )
    with closing(completed(executor, solve_group, tasks, shapes)) as ended:
        for index, (solved, error) in ended:
            c, rows = places[index]
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

"""Training of the shapes for all components, on random combinations of the components.

With ``r_j ~ N(0, 1)``, ``sum_j r_j sqrt(lambda_j) Psi_j`` is a sample of the PCA model. The r_j are
independent, so the expected squared error of the rendered sample is ``sum_j lambda_j |Psi~_j -
Psi_j|^2``. One rendering is therefore an unbiased estimate of the error of the whole basis. Each
step solves for the colours first; at their optimum, the total derivative by the shapes equals the
partial derivative (variable projection).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...backend.arrays import types_of
from ...backend.recording import freeze_program
from ...fitting.descent import pack, rate_table, start_descent, step_program
from ...fitting.schedule import Schedule, lr_factor
from ...fitting.solvers.conjugate_gradient import solve
from ...fitting.start import place_grid
from ...gaussian.gaussians import Gaussians
from ...raster.binning.tiles import Grid
from ...raster.render import bin_gaussians, to_tiles

Planes = NDArray[np.float32]
State = dict[str, NDArray[Any]]

ROUND = 25
"""Steps between two restarts of the optimiser; a checkpoint after a round needs the shapes alone.
"""

SOLVE_STEPS = 30
"""Steps of conjugate gradients for the colours of a sample. With 8 steps, the derivative has an
error of a third."""

SCHEDULE = Schedule(
    optimizer="adam",
    settings={"beta_1": 0.9, "beta_2": 0.99, "epsilon": 1e-12},
    rates={"mean": 0.02, "factor": 0.02},
    warm_up=0,
)
"""Schedule of the descent. The learning rates are a sixth of those for one image, because each step
has another sample."""

WARM_UP = 5
"""Steps of rising learning rates at the start of each round."""


def train_shapes(
    components: tuple[Planes, ...],
    eigenvalues: tuple[NDArray[np.float64], ...],
    count: int,
    seed: int,
    steps: int,
    backend: str | None = None,
    state: State | None = None,
) -> Iterator[State]:
    """Train the means and factors of Gaussians, from a grid, to render all components.

    Parameters
    ----------
    components : tuple of C ndarrays of float32, shape (k_c, H, W)
        Components of each channel.
    eigenvalues : tuple of C ndarrays, shape (k_c,)
        Variance along each component.
    count : int
        Number of Gaussians.
    seed : int
        Seed of the random combinations; seed and step determine a combination.
    steps : int
        Total number of steps; 0 keeps the grid.
    backend : {"llvm", "cuda"}, optional
    state : dict, optional
        Resume from this earlier result, as if the training had not stopped.

    Yields
    ------
    dict of str to ndarray
        "step", "mean" and "factor", at the start, after every `ROUND` steps and at the end.

    Raises
    ------
    ValueError
        If `state` has another number of Gaussians, or more steps than `steps`.
    """
    height, width = components[0].shape[1:]
    if state is None:
        state = on_grid((width, height), count)
        yield state
    elif (
        not {"step", "mean", "factor"} <= state.keys()
        or len(state["mean"]) != count
        or not 0 <= state["step"] <= steps
    ):
        raise ValueError("state: it does not fit this number of Gaussians and steps; drop it")
    gaussians = shapes_of(state, (width, height), len(components), backend)
    if not any(len(values) for values in eigenvalues):
        return
    for first in range(int(state["step"]), steps, ROUND):
        last = min(first + ROUND, steps)
        gaussians = _round(gaussians, components, eigenvalues, seed, (first, last, steps))
        arrays = gaussians.to_arrays()
        yield {"step": np.array(last), "mean": arrays["mean"], "factor": arrays["factor"]}


def on_grid(size: tuple[int, int], count: int) -> State:
    """Return the state before training, `count` Gaussians on a grid of a size (width, height)."""
    mean, factor = place_grid(np.empty((size[1], size[0], 1)), count, np.random.default_rng(0))
    return {"step": np.array(0), "mean": mean, "factor": factor}


def shapes_of(
    state: State, size: tuple[int, int], channels: int, backend: str | None = None
) -> Gaussians:
    """Return the Gaussians of a state, with colours of 0 in the space "data"."""
    colors = np.zeros((len(state["mean"]), channels))
    return Gaussians.from_arrays(
        state["mean"], state["factor"], colors, size=size, space="data", backend=backend
    )


def _round(
    gaussians: Gaussians,
    components: tuple[Planes, ...],
    eigenvalues: tuple[NDArray[np.float64], ...],
    seed: int,
    span: tuple[int, int, int],
) -> Gaussians:
    """Take the steps from `first` to before `last` of a span, with a new optimiser."""
    first, last, steps = span
    types, grid = types_of(gaussians.mean), Grid(gaussians.width, gaussians.height)
    state = start_descent(gaussians, SCHEDULE)
    factors = [
        lr_factor(SCHEDULE, step, steps) * min(1.0, (step - first + 1) / WARM_UP)
        for step in range(first, last)
    ]
    rates = rate_table(types, SCHEDULE, factors)
    with freeze_program(step_program(SCHEDULE, gaussians)) as take_step:
        for index, image in enumerate(samples(components, eigenvalues, seed, first, last)):
            solved = solve(state.gaussians, image, SOLVE_STEPS).gaussians
            fixed = replace(gaussians, color=solved.color, background=solved.background)
            state = take_step(
                replace(state, packed=pack(solved)),
                fixed,
                to_tiles(types, image, grid),
                None,
                [bin_gaussians(solved)],
                rates,
                dr.opaque(types.UInt, index),
            )
    return dr.detach(state.gaussians)


def samples(
    components: tuple[Planes, ...],
    eigenvalues: tuple[NDArray[np.float64], ...],
    seed: int,
    first: int,
    last: int,
) -> Planes:
    """Draw random combinations of the components, without the mean image.

    Returns
    -------
    ndarray of float32, shape (last - first, H, W, C)
        Combination i depends on `seed` and ``first + i`` alone.
    """
    channels = []
    for c, (planes, values) in enumerate(zip(components, eigenvalues, strict=True)):
        r = [
            np.random.default_rng([seed, i, c]).normal(size=len(planes)) for i in range(first, last)
        ]
        spread = (np.stack(r) * np.sqrt(values)).astype(np.float32)
        channels.append(np.tensordot(spread, planes, axes=1))
    return np.stack(channels, axis=3)

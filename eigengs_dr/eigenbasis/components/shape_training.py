"""Training the shapes that all components share, on random combinations of the components.

With ``r_j ~ N(0, 1)``, ``sum_j r_j sqrt(lambda_j) Psi_j`` is a sample of the PCA model, and because
the r_j are independent, the expected squared error of its rendering is ``sum_j lambda_j |Psi~_j -
Psi_j|^2``: one rendering is an unbiased estimate of the error of the whole basis. Colours are
solved for in every step; at their optimum the derivative with respect to the shapes is the partial
one (variable projection).
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
from ...fitting.optimizers.descent import step_program
from ...fitting.optimizers.schedule import Schedule, lr_factor
from ...fitting.placement.grid import place_grid
from ...fitting.solvers.conjugate_gradient import solve
from ...gaussian.gaussians import Gaussians
from ...raster.render import bin_gaussians, to_tiles
from ...raster.tiles import Grid

Planes = NDArray[np.float32]
State = dict[str, NDArray[Any]]

ROUND = 25
"""Steps after which the optimiser starts anew: then shapes are all that a checkpoint holds."""

SOLVE_STEPS = 30
"""Steps of conjugate gradients for the colours of a sample: with 8, the derivative is off by a
third."""

SCHEDULE = Schedule(
    optimizer="adam",
    settings={"beta_1": 0.9, "beta_2": 0.99, "epsilon": 1e-12},
    rates={"mean": 0.02, "factor": 0.02},
    warm_up=0,
)
"""Every step sees another sample: rates are a sixth of those that refine one image."""

WARM_UP = 5
"""Steps over which the rates rise in every round."""


def train_shapes(
    components: tuple[Planes, ...],
    eigenvalues: tuple[NDArray[np.float64], ...],
    count: int,
    seed: int,
    steps: int,
    backend: str | None = None,
    state: State | None = None,
) -> Iterator[State]:
    """Move and reshape splats, from a grid on, until they render all components better.

    Parameters
    ----------
    components : tuple of ndarray of float32, shape (k, H, W)
        Of every channel.
    eigenvalues : tuple of ndarray, shape (k,)
        Variance along each.
    count : int
        Number of splats.
    seed : int
        Of the random combinations; the one of a step depends on nothing else.
    steps : int
        Steps in all; none leaves the grid.
    backend : {"llvm", "cuda"}, optional
    state : dict, optional
        One that was yielded before: goes on as if it had not stopped.

    Yields
    ------
    dict of str to ndarray
        "step", "mean" and "factor": at the start, after every `ROUND` steps and at the end.
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
        raise ValueError("state: it is not of this number of splats and steps")
    gaussians = shapes_of(state, (width, height), len(components), backend)
    if not any(len(values) for values in eigenvalues):
        return
    for first in range(int(state["step"]), steps, ROUND):
        last = min(first + ROUND, steps)
        gaussians = _round(gaussians, components, eigenvalues, seed, (first, last, steps))
        arrays = gaussians.to_arrays()
        yield {"step": np.array(last), "mean": arrays["mean"], "factor": arrays["factor"]}


def on_grid(size: tuple[int, int], count: int) -> State:
    """Return the state before training: `count` splats on a grid of a size (width, height)."""
    mean, factor = place_grid(np.empty((size[1], size[0], 1)), count, np.random.default_rng(0))
    return {"step": np.array(0), "mean": mean, "factor": factor}


def shapes_of(
    state: State, size: tuple[int, int], channels: int, backend: str | None = None
) -> Gaussians:
    """Make a set of the shapes of a state, without colours; its space is "data"."""
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
    """Take steps from the first to before the last, with an optimiser of their own."""
    first, last, steps = span
    types, coordinates = types_of(gaussians.mean), SCHEDULE.variables()
    variables = coordinates.encode(gaussians)
    optimizer = SCHEDULE.make_optimizer()
    optimizer.update({name: variables[name] for name in SCHEDULE.rates})
    place_grid = Grid(gaussians.width, gaussians.height)
    whole = np.ones((gaussians.height, gaussians.width, len(components)), np.float32)
    inside = to_tiles(types, whole, place_grid)
    current = gaussians
    with freeze_program(step_program(coordinates)) as take_step:
        for step, image in enumerate(samples(components, eigenvalues, seed, first, last), first):
            solved = solve(current, image, SOLVE_STEPS).gaussians
            fixed = replace(gaussians, color=solved.color, background=solved.background)
            left = lr_factor(SCHEDULE, step, steps) * min(1.0, (step - first + 1) / WARM_UP)
            optimizer.set_learning_rate(
                {name: dr.opaque(types.Float, rate * left) for name, rate in SCHEDULE.rates.items()}
            )
            target = to_tiles(types, image, place_grid)
            take_step(optimizer, fixed, target, inside, [bin_gaussians(current)])
            current = coordinates.decode(fixed, dict(optimizer))
            dr.eval(current)
    return dr.detach(current)


def samples(
    components: tuple[Planes, ...],
    eigenvalues: tuple[NDArray[np.float64], ...],
    seed: int,
    first: int,
    last: int,
) -> Planes:
    """Draw random combinations of the components, less the mean image.

    Returns
    -------
    ndarray of float32, shape (last - first, H, W, C)
        Number i depends on `seed` and ``first + i`` alone.
    """
    channels = []
    for c, (planes, values) in enumerate(zip(components, eigenvalues, strict=True)):
        r = [
            np.random.default_rng([seed, i, c]).normal(size=len(planes)) for i in range(first, last)
        ]
        spread = (np.stack(r) * np.sqrt(values)).astype(np.float32)
        channels.append(np.tensordot(spread, planes, axes=1))
    return np.stack(channels, axis=3)

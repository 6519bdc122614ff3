"""Gradient descent on all parameters of the Gaussians of one image."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np

from ...backend.arrays import types_of
from ...backend.recording import freeze_program
from ...gaussian.gaussians import Gaussians
from ...raster.parameters import kernel_parameters
from ...raster.render import bin_gaussians, rasterize, to_tiles
from ...raster.tiles import Grid, TileLists
from ..initializers import FitProblem
from .parameterization import Parameterization
from .schedule import MIN_PHASE_RATIO, Schedule, lr_factor

MSE_EPSILON = 1e-10
"""Mean squared error added before the logarithm, which would diverge at an error of 0."""


def descend(
    problem: FitProblem, schedule: Schedule, iterations: int, levels: Sequence[int] = ()
) -> Generator[Gaussians, None, None]:
    """Yield the set before the first step and after every step of gradient descent.

    Parameters
    ----------
    problem : FitProblem
        The start and the target. If the problem can redistribute and the run is long enough, a
        first phase of `Schedule.redistribute_after` steps shows where error is left. The rest of
        the steps then starts from redistributed Gaussians.
    schedule : Schedule
    iterations : int
        Number of steps, with the first phase.
    levels : sequence of int, optional
        Numbers n. The first n Gaussians shall form the image too, as well as they can.

    Yields
    ------
    Gaussians
        The current set. Steps run asynchronously: its arrays may not be computed yet.
    """
    yield problem.gaussians
    first = schedule.redistribute_after
    if problem.redistribute and first > 0 and iterations >= MIN_PHASE_RATIO * first:
        for current in _run_phase(problem, schedule, first):
            yield current
        anew = problem.redistribute(dr.detach(current), len(current))
        problem, iterations = problem._replace(gaussians=anew), iterations - first
    yield from _run_phase(problem, schedule, iterations, levels)


def _run_phase(
    problem: FitProblem, schedule: Schedule, iterations: int, levels: Sequence[int] = ()
) -> Generator[Gaussians, None, None]:
    """Yield the set after every step of one phase.

    Tile lists last `schedule.rebuild` steps: they list Gaussians enlarged by `schedule.pad`.
    """
    gaussians, target, weight = problem.gaussians, problem.target, problem.weight
    types = types_of(gaussians.mean)
    coordinates = schedule.variables()
    start = coordinates.encode(gaussians)
    optimizer = schedule.make_optimizer()
    optimizer.update({name: start[name] for name in schedule.rates})
    current = gaussians
    grid = Grid(gaussians.width, gaussians.height)
    tiles = to_tiles(types, target, grid)
    weights = to_tiles(types, np.ones_like(target) if weight is None else weight, grid)
    zero = dr.opaque(types.Float, 0)
    with freeze_program(step_program(coordinates, levels)) as take_step:
        for step in range(iterations):
            if step % schedule.rebuild == 0:
                lists = [
                    bin_gaussians(prefix(current, count), schedule.pad)
                    for count in (*levels, len(current))
                ]
            left = lr_factor(schedule, step, iterations)
            optimizer.set_learning_rate(
                {name: dr.opaque(types.Float, rate * left) for name, rate in schedule.rates.items()}
            )
            take_step(optimizer, gaussians, tiles, weights, lists)
            current = coordinates.decode(gaussians, dict(optimizer))
            # Later steps write into the optimiser's arrays, so the yielded set must be a copy.
            current = replace(current, color=current.color + zero)
            dr.eval(current)
            yield current


def step_program(coordinates: Parameterization, levels: Sequence[int] = ()) -> Any:
    """Make the function of one step for `eigengs_dr.backend.recording.freeze_program`.

    Dr.Jit traces the function once and replays it without Python. The program belongs to one run: a
    replay does not notice other settings, such as the betas of another optimiser.
    """

    def step(
        optimizer: Any, fixed: Gaussians, target: Any, weights: Any, lists: list[TileLists]
    ) -> None:
        """Descend on the mean squared error, then project the variables into their bounds.

        The weights are 0 outside the image, where tiles overhang it.
        """
        current = coordinates.decode(fixed, dict(optimizer))
        errors = [
            _error(prefix(current, count), target, weights, listed)
            for count, listed in zip((*levels, len(fixed)), lists, strict=True)
        ]
        # With levels, sum the logarithms of the errors, so that no level suffers for another.
        loss = sum(dr.log(e + MSE_EPSILON) for e in errors) if levels else errors[0]
        dr.backward(loss)
        # Evaluated apart from the optimiser's arithmetic, the large kernels serve every preset.
        dr.eval([dr.grad(v) for v in optimizer.values()])
        optimizer.step(eval=False)
        optimizer.update(coordinates.project(fixed, dict(optimizer)))

    return step


def _error(gaussians: Gaussians, target: Any, weights: Any, lists: TileLists) -> Any:
    rendered = rasterize(kernel_parameters(gaussians), lists, gaussians.cutoff)
    return dr.mean(dr.square((rendered - target) * weights))


def prefix(gaussians: Gaussians, count: int) -> Gaussians:
    """Return the first `count` Gaussians of a set, differentiably, also in a frozen program."""
    if count == len(gaussians):
        return gaussians
    types = types_of(gaussians.mean)
    index = dr.arange(types.UInt, count)

    def take(rows: Any) -> Any:
        return type(rows)([dr.gather(types.Float, row, index) for row in rows])

    return replace(
        gaussians,
        mean=take(gaussians.mean),
        factor=take(gaussians.factor),
        color=take(gaussians.color),
    )

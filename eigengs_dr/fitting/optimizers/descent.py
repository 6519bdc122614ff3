"""Gradient descent on all parameters of one image's Gaussians, step by step."""

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
"""Mean squared error that is not told from none."""


def descend(
    problem: FitProblem, schedule: Schedule, iterations: int, levels: Sequence[int] = ()
) -> Generator[Gaussians, None, None]:
    """Yield the set before the first step and after every step of gradient descent.

    Parameters
    ----------
    problem : FitProblem
        The start and the aim. If it can redistribute, and the run is long enough, a first phase of
        `Schedule.redistribute_after` steps shows where error is left; Gaussians are then placed
        anew, and a descent of its own follows.
    schedule : Schedule
    iterations : int
        Steps in all.
    levels : sequence of int, optional
        Numbers of Gaussians, from the first, that shall make the image too, as well as they can.

    Yields
    ------
    Gaussians
        Steps run asynchronously: the arrays of a set may not be computed yet.
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
    """Yield the set after every step of one descent.

    Between two builds the tile lists are of where the Gaussians were, enlarged by `schedule.pad`.
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
            # Later steps write into the optimiser's arrays: what is yielded must be a copy.
            current = replace(current, color=current.color + zero)
            dr.eval(current)
            yield current


def step_program(coordinates: Parameterization, levels: Sequence[int] = ()) -> Any:
    """Make the function of a step, to be frozen: traced once, replayed without Python.

    A program belongs to one run: a replay does not notice that, say, the betas of another optimiser
    differ.
    """

    def step(
        optimizer: Any, fixed: Gaussians, target: Any, weights: Any, lists: list[TileLists]
    ) -> None:
        """Descend on the mean squared error, then bring the variables back inside their bounds.

        The weights are 0 where tiles overhang the image.
        """
        current = coordinates.decode(fixed, dict(optimizer))
        errors = [
            _error(prefix(current, count), target, weights, listed)
            for count, listed in zip((*levels, len(fixed)), lists, strict=True)
        ]
        # Of several, the sum of their decibels: none is sacrificed for another.
        loss = sum(dr.log(e + MSE_EPSILON) for e in errors) if levels else errors[0]
        dr.backward(loss)
        # Kept apart from the optimiser's arithmetic, the large kernels serve every preset.
        dr.eval([dr.grad(v) for v in optimizer.values()])
        optimizer.step(eval=False)
        optimizer.update(coordinates.project(fixed, dict(optimizer)))

    return step


def _error(gaussians: Gaussians, target: Any, weights: Any, lists: TileLists) -> Any:
    rendered = rasterize(kernel_parameters(gaussians), lists, gaussians.cutoff)
    return dr.mean(dr.square((rendered - target) * weights))


def prefix(gaussians: Gaussians, count: int) -> Gaussians:
    """The first splats of a set; differentiable, also in a frozen program."""
    if count == len(gaussians):
        return gaussians
    types = types_of(gaussians.mean)
    index = dr.arange(types.UInt, count)

    def taken(rows: Any) -> Any:
        return type(rows)([dr.gather(types.Float, row, index) for row in rows])

    return replace(
        gaussians,
        mean=taken(gaussians.mean),
        factor=taken(gaussians.factor),
        color=taken(gaussians.color),
    )

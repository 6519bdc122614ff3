"""The fit of one block: pure functions of pixels and numbers, which may run on any machine.

A fit works on the window of the block, with all Gaussians whose means lie in it. Those in the halo
belong to other blocks. Blocks are fitted in four phases, so that neighbours never are at once. The
Gaussians of a neighbour that is done stay fixed, and the block fits what they leave. Those of a
neighbour that is not move too: they stand in for what it will draw, and the result leaves them out.
So every border has a side that has seen the other. At the end some steps move the Gaussians of both
sides of a border, with all others fixed. PSNR in dB of the 16 pixels around borders, and elsewhere
beyond 32 pixels (1,024x1,024 pixels in blocks of 256, one Gaussian for 20 pixels):

| method | 200 steps | 1,000 steps |
|---|---|---|
| all blocks at once, with stand-ins alone (an earlier version) | 30.65, 36.40 | 27.38, 37.77 |
| in phases | 35.85, 36.48 | 37.03, 37.93 |
| in phases, then along the borders | 36.09, 36.48 | 37.41, 37.93 |
| a fit of the whole | 36.14, 36.49 | 37.60, 37.94 |
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.recording import exclusive
from ..fitting.initializers import FitProblem, FitTarget, make_target
from ..fitting.optimizers.descent import descend
from ..fitting.optimizers.schedule import Schedule
from ..fitting.options import FitOptions
from ..fitting.placement.adaptive import density_from_hessian
from ..fitting.placement.density import density_ratio, scale_by_owner
from ..fitting.placement.nearest import nearest_center
from ..fitting.redistribute import residual, squared_error
from ..fitting.solvers.conjugate_gradient import solve
from ..gaussian.file import SetData
from ..gaussian.gaussians import Gaussians
from .draw import draw
from .grid import Block, choose_halo
from .place import OldSet, place_block, placement_image, window_density
from .source import Window
from .window_gaussians import WindowGaussians

Array = NDArray[np.floating]
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Settings:
    """What all tasks of a run share.

    Attributes
    ----------
    options : FitOptions
    size : (int, int)
        Width and height of the image in pixels.
    spacing : float
        Mean distance of the Gaussians, in pixels.
    background : tuple of float
        Value of every pixel before the Gaussians are added, in the space of the colours.
    """

    options: FitOptions
    size: tuple[int, int]
    spacing: float
    background: tuple[float, ...] = ()


MAX_RATE = 0.12
"""Largest learning rate of the fit of a block. With the rates of `eigengs_dr.fit` blocks lose 5 dB,
because stand-ins for neighbours move too far (1,024x1,024 pixels in blocks of 256, 1,000 steps)."""


MEND_RATE = 0.3
"""Learning rates of `mend_seam`, as a fraction of those of the fit of a block."""


class Surveyed(NamedTuple):
    """Result of `survey`: the integral of the density over the core, and the sums of its values."""

    mass: float
    total: NDArray[np.float64]


class PlaceTask(NamedTuple):
    """A block whose Gaussians shall be placed; see `eigengs_dr.blocks.place.place_block`."""

    window: Window
    block: Block
    gaussians: int = 0
    old: OldSet | None = None


class FitTask(NamedTuple):
    """A block, or a strip along a border, whose Gaussians shall be fitted.

    Attributes
    ----------
    window : Window
        The pixels.
    block : Block
    mean, factor : ndarray of float32, shapes (N, 2) and (N, 3)
        The Gaussians that move, as they start; in pixels of the window.
    color : ndarray of float32, shape (N, C), or None
        Their colours; by default a solve finds the first ones.
    own : slice
        Those of them that belong to the block.
    fixed : dict of str to ndarray, or None
        Mean, factor and color of other Gaussians that touch the window.
    iterations : int
        Number of steps.
    """

    window: Window
    block: Block
    mean: Array
    factor: Array
    color: Array | None
    own: slice
    fixed: Arrays | None
    iterations: int


def survey(task: PlaceTask, settings: Settings) -> Surveyed:
    """Measure how many Gaussians a block needs, relative to others, before any fit."""
    options = settings.options
    target = make_target(task.window.read(), options.color)
    density = window_density(placement_image(target, options.color), settings.spacing)
    core = task.block.core
    return Surveyed(
        float(density[core].sum(dtype=np.float64)),
        target.values[core].sum(axis=(0, 1), dtype=np.float64),
    )


def place(task: PlaceTask, settings: Settings) -> tuple[Array, Array]:
    """Place the Gaussians of a block; see `eigengs_dr.blocks.place.place_block`."""
    options = settings.options
    target = make_target(task.window.read(), options.color)
    image = placement_image(target, options.color)
    return place_block(image, task.block, task.gaussians, settings.spacing, task.old)


StepDone = Callable[[int], None]
"""``step_done(step)`` every 10 steps of a fit. It may raise an error to end the fit."""


@exclusive()
def find_density(task: FitTask, settings: Settings, step_done: StepDone | None = None) -> Arrays:
    """Fit the Gaussians of a window for some steps; return the density that their errors ask for.

    Returns
    -------
    dict of str to ndarray
        The means (n, 2) of the own Gaussians in pixels of the window, ratio (n, 1), see
        `eigengs_dr.blocks.place.OldSet`, and the mass (1,) of the density in the core.
    """
    target = make_target(task.window.read(), settings.options.color)
    problem = _start(task, target, settings)
    found = _descend(problem, _schedule(settings), task.iterations, step_done)
    mean = found.to_arrays()["mean"]
    density = density_from_hessian(placement_image(target, found.space), settings.spacing)
    owner = nearest_center(mean, density.shape)
    ratio = density_ratio(mean, owner, _squared_error(found, problem), density)
    scale_by_owner(density, owner, ratio)
    return {
        "mean": mean[task.own],
        "ratio": ratio[task.own, None].astype(np.float32),
        "mass": np.array([density[task.block.core].sum(dtype=np.float64)]),
    }


@exclusive()
def fit_block(task: FitTask, settings: Settings, step_done: StepDone | None = None) -> Arrays:
    """Fit the Gaussians of a window, and return those of its block.

    Returns
    -------
    dict of str to ndarray
        Mean, factor and color of the own Gaussians, in pixels of the window.
    """
    return _fit(task, settings, _schedule(settings), step_done)


@exclusive()
def mend_seam(task: FitTask, settings: Settings, step_done: StepDone | None = None) -> Arrays:
    """Move the Gaussians along a border, those of both sides; results as those of `fit_block`."""
    schedule = _schedule(settings)
    rates = {name: MEND_RATE * rate for name, rate in schedule.rates.items()}
    return _fit(task, settings, replace(schedule, rates=rates), step_done)


def _schedule(settings: Settings) -> Schedule:
    """Return the schedule of the method with rates for blocks."""
    schedule = settings.options.method.schedule
    rates = {name: min(rate, MAX_RATE) for name, rate in schedule.rates.items()}
    return replace(schedule, rates=rates)


def _fit(
    task: FitTask, settings: Settings, schedule: Schedule, step_done: StepDone | None
) -> Arrays:
    problem = _start(task, make_target(task.window.read(), settings.options.color), settings)
    found = _descend(problem, schedule, task.iterations, step_done)
    if _squared_error(found, problem).sum() > _squared_error(problem.gaussians, problem).sum():
        found = problem.gaussians  # as on an image that the colour solve fits without error
    arrays = found.to_arrays()
    return {name: arrays[name][task.own] for name in ("mean", "factor", "color")}


def _start(task: FitTask, target: FitTarget, settings: Settings) -> FitProblem:
    """Return the Gaussians with their first colours, and what the fixed ones leave to them."""
    options, values = settings.options, target.values
    height, width, channels = values.shape
    background = np.array(settings.background, np.float32)
    if task.fixed is not None and len(task.fixed["mean"]):
        arrays = task.fixed | {"background": np.zeros(channels, np.float32)}
        others = SetData(arrays, (width, height), "data", options.cutoff)
        values = values - draw(others, options.backend)
    placed = Gaussians.from_arrays(
        task.mean,
        task.factor,
        np.zeros((len(task.mean), channels), np.float32) if task.color is None else task.color,
        background,
        size=(width, height),
        space=options.color,
        backend=options.backend,
        cutoff=options.cutoff,
    ).bounded()
    sides = task.block.open_sides(*settings.size)
    placed = WindowGaussians.in_window(placed, choose_halo(settings.spacing), sides)
    if task.color is None:
        placed = solve(placed, values, options.solve_steps, background=background).gaussians
    return FitProblem(placed, values, target.weight)


def _descend(
    problem: FitProblem, schedule: Schedule, iterations: int, step_done: StepDone | None
) -> Gaussians:
    found = problem.gaussians
    with closing(descend(problem, schedule, iterations)) as sets:
        for step, reached in enumerate(sets):
            found = reached
            if step_done and step % 10 == 0:
                dr.sync_thread()  # steps run asynchronously
                step_done(step)
    return dr.detach(found)


def _squared_error(found: Gaussians, problem: FitProblem) -> NDArray[np.float32]:
    return squared_error(residual(found, problem.target), problem.weight)

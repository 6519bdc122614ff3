"""The fit of one block: pure functions of pixels and numbers, which may run on any machine.

A fit works on the window of the block, with all Gaussians whose means lie in it. Those in the halo
belong to other blocks. Blocks are fitted in four phases, so that neighbours never are at once. The
Gaussians of a neighbour that is done stay fixed, and the block fits what they leave. Those of a
neighbour that is not move too: they stand in for what it will draw, and the result leaves them out.
So every border has a side that has seen the other, and no seam is left. On 1,024x1,024 pixels in
blocks of 256, 60 steps, the 16 pixels around borders have the PSNR of a fit of the whole, 32.22 dB;
if all blocks only have stand-ins, they have 31.48 dB.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.recording import exclusive
from ..fitting.initializers import FitProblem, FitTarget, make_target
from ..fitting.optimizers.descent import descend
from ..fitting.options import FitOptions
from ..fitting.placement.adaptive import density_from_hessian
from ..fitting.placement.density import density_ratio, scale_by_owner
from ..fitting.placement.nearest import nearest_center
from ..fitting.redistribute import residual, squared_error
from ..fitting.solvers.conjugate_gradient import solve
from ..gaussian.file import SetData
from ..gaussian.gaussians import Gaussians
from .draw import draw
from .grid import Block
from .place import OldSet, place_block, placement_image, window_density
from .source import Window

Array = NDArray[np.floating]
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Settings:
    """What all tasks of a run share.

    Attributes
    ----------
    options : FitOptions
    spacing : float
        Mean distance of the Gaussians, in pixels.
    background : tuple of float
        Value of every pixel before the Gaussians are added, in the space of the colours.
    """

    options: FitOptions
    spacing: float
    background: tuple[float, ...] = ()


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
    """A block whose Gaussians shall be fitted.

    Attributes
    ----------
    window : Window
        The pixels.
    block : Block
    mean, factor : ndarray of float32, shapes (N, 2) and (N, 3)
        The Gaussians of the window, as they start; in its pixels.
    own : slice
        Those of the block.
    iterations : int
        Number of steps.
    fixed : dict of str to ndarray, or None
        Mean, factor and color of the Gaussians of other blocks that are done and touch the window.
        None for a trial, whose result is the density that its errors ask for.
    """

    window: Window
    block: Block
    mean: Array
    factor: Array
    own: slice
    iterations: int
    fixed: Arrays | None


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


@exclusive()
def fit_block(
    task: FitTask,
    settings: Settings,
    step_done: Callable[[int], None] | None = None,
) -> Arrays:
    """Fit the Gaussians of a window, and return those of its block.

    Parameters
    ----------
    task : FitTask
    settings : Settings
    step_done : callable, optional
        ``step_done(step)`` every 10 steps. It may raise an error to end the fit.

    Returns
    -------
    dict of str to ndarray
        Mean, factor and color of the own Gaussians, in pixels of the window. For a trial, mean,
        ratio (see `eigengs_dr.blocks.place.OldSet`), and the mass (1,) of the density.
    """
    options = settings.options
    target = make_target(task.window.read(), options.color)
    problem = _start(task, target, settings)
    found = problem.gaussians
    with closing(descend(problem, options.method.schedule, task.iterations)) as sets:
        for step, reached in enumerate(sets):
            found = reached
            if step_done and step % 10 == 0:
                dr.sync_thread()
                step_done(step)
    found = dr.detach(found)
    error = _squared_error(found, problem)
    if task.fixed is None:
        return _wanted(found, error, placement_image(target, options.color), settings, task)
    if error.sum() > _squared_error(problem.gaussians, problem).sum():
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
        values = values - draw(
            SetData(arrays, (width, height), "data", options.cutoff), options.backend
        )
    placed = Gaussians.from_arrays(
        task.mean,
        task.factor,
        np.zeros((len(task.mean), channels), np.float32),
        background,
        size=(width, height),
        space=options.color,
        backend=options.backend,
        cutoff=options.cutoff,
    ).bounded()
    solved = solve(placed, values, options.solve_steps, background=background).gaussians
    return FitProblem(solved, values, target.weight)


def _squared_error(found: Gaussians, problem: FitProblem) -> NDArray[np.float32]:
    return squared_error(residual(found, problem.target), problem.weight)


def _wanted(
    found: Gaussians,
    error: NDArray[np.float32],
    image: NDArray[np.float32],
    settings: Settings,
    task: FitTask,
) -> Arrays:
    """Return the density that the errors of a fit ask for."""
    mean = found.to_arrays()["mean"]
    density = density_from_hessian(image, settings.spacing)
    owner = nearest_center(mean, density.shape)
    ratio = density_ratio(mean, owner, error, density)
    scale_by_owner(density, owner, ratio)
    mass = density[task.block.core].sum(dtype=np.float64)
    return {
        "mean": mean[task.own],
        "ratio": ratio[task.own, None].astype(np.float32),
        "mass": np.array([mass]),
    }

"""The fit of one block: pure functions of pixels and numbers, which may run on any machine.

A fit works on the window of the block, with all Gaussians whose means lie in it; those that only
touch it are fixed. It moves them all, but returns those of the block alone: those of neighbours
stand in for what the neighbours do at the same time. Between rounds of steps every block sees what
the others have reached.

In one round, with stand-ins to the end, no block would see what its neighbours draw, and seams
would stay along the borders. Blocks that wait for the results of their neighbours would fit to
Gaussians that no longer move, and not at the same time.

Gaussians start by the adaptive placement, of one density over all blocks. Every Gaussian belongs to
one block, which places it in its core. The density depends on the pixels around the core too, so
that it is the density of the whole image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.recording import exclusive
from ..fitting.density_control import Part, PartControl
from ..fitting.descent import FitProblem, run
from ..fitting.options import FitOptions
from ..fitting.placement.adaptive import (
    density_from_hessian,
    lloyd_step,
    normalize_density,
    residual,
    shapes_from_hessian,
    squared_error,
    stratify_along_hilbert,
)
from ..fitting.placement.density import density_ratio, nearest_center, scale_by_owner
from ..fitting.schedule import Schedule, relocations
from ..fitting.solvers.conjugate_gradient import solve
from ..fitting.target import BRIGHT, WHITE, FitTarget, make_target, read_data, unit_of
from ..gaussian.file import SetData
from ..gaussian.gaussians import Gaussians
from ..image.pixels import ImageError
from .draw import draw
from .grid import Block
from .windows import Window

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


class Surveyed(NamedTuple):
    """Result of `survey`: the integral of the density over the core, and the sums of its values.

    Data have a unit too: 1, or the largest magnitude, see `eigengs_dr.fitting.target.unit_of`.
    """

    mass: float
    total: NDArray[np.float64]
    unit: float


class PlaceTask(NamedTuple):
    """A block whose Gaussians shall be placed; see `eigengs_dr.blocks.block.place_block`."""

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
        The Gaussians whose means lie in the window, as they start; in pixels of the window.
    color : ndarray of float32, shape (N, C), or None
        Their colours; by default a solve finds the first ones.
    own : slice
        Those of them that belong to the block.
    fixed : dict of str to ndarray, or None
        Mean, factor and color of other Gaussians that touch the window.
    iterations : int
        Number of steps of the whole fit.
    part : range
        Those of them that shall be taken.
    """

    window: Window
    block: Block
    mean: Array
    factor: Array
    color: Array | None
    own: slice
    fixed: Arrays | None
    iterations: int
    part: range


def survey(task: PlaceTask, settings: Settings) -> Surveyed:
    """Measure how many Gaussians a block needs, relative to others, before any fit."""
    options = settings.options
    pixels = task.window.read()
    bright = BRIGHT.get(options.space)
    if bright and task.window.encoding == "linear" and pixels.max() > WHITE:
        raise ImageError(f"{task.window.name}: light above 1; give the space {bright!r}")
    if options.space == "normal":
        read_data(pixels, options.space)  # no other range makes normals
    target = make_target(pixels, options.space)
    density = window_density(target.shown, settings.spacing)
    core = task.block.core
    return Surveyed(
        float(density[core].sum(dtype=np.float64)),
        target.values[core].sum(axis=(0, 1), dtype=np.float64),
        unit_of(pixels, options.space),
    )


def place(task: PlaceTask, settings: Settings) -> tuple[Array, Array]:
    """Place the Gaussians of a block; see `eigengs_dr.blocks.block.place_block`."""
    options = settings.options
    target = make_target(task.window.read(), options.space)
    image = target.shown
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
        `eigengs_dr.blocks.block.OldSet`, and the mass (1,) of the density in the core.
    """
    target = make_target(task.window.read(), settings.options.space)
    problem = _start(task, target, settings)
    found = _descend(problem, task, settings, step_done)
    mean = found.to_arrays()["mean"]
    density = density_from_hessian(target.shown, settings.spacing)
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
    """Take some steps of the fit of a window, and return the Gaussians of its block.

    Returns
    -------
    dict of str to ndarray
        Mean, factor and color of the own Gaussians, in pixels of the window.
    """
    target = make_target(task.window.read(), settings.options.space)
    problem = _start(task, target, settings)
    part = Part(task.own, task.block.core)
    control = PartControl(problem.target, problem.weight, target.shown, part=part)
    found = _descend(problem._replace(control=control), task, settings, step_done)
    if task.part.stop == task.iterations:
        # The last steps may make a set worse that is nearly perfect; earlier ones, any set.
        before, after = (_squared_error(g, problem).sum() for g in (problem.gaussians, found))
        found = found if after < before else problem.gaussians
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
        space=options.space,
        backend=options.backend,
        cutoff=options.cutoff,
    ).bounded()
    if task.color is None:
        placed = solve(placed, values, options.solve_steps, background=background).gaussians
    return FitProblem(placed, values, target.weight)


def _descend(
    problem: FitProblem, task: FitTask, settings: Settings, step_done: StepDone | None
) -> Gaussians:
    def after(taken: int, found: Gaussians) -> bool:
        if step_done and taken and taken % 10 == 0:
            dr.sync_thread()  # steps run asynchronously
            step_done(taken)
        return False

    schedule = settings.options.method.schedule
    return run(problem, schedule, task.iterations, after, part=task.part)


def _squared_error(found: Gaussians, problem: FitProblem) -> NDArray[np.float32]:
    return squared_error(residual(found, problem.target), problem.weight)


class OldSet(NamedTuple):
    """What a fit has shown about the density.

    Attributes
    ----------
    mean : ndarray, shape (N, 2)
        Means of the Gaussians of a window, in its pixels.
    ratio : ndarray, shape (N,)
        See `eigengs_dr.fitting.placement.density.density_ratio`.
    """

    mean: Array
    ratio: Array


def window_density(image: Array, spacing: float, old: OldSet | None = None) -> NDArray[np.float32]:
    """Return the density of Gaussians in a window, up to a factor that all windows share.

    Parameters
    ----------
    image : ndarray, shape (H, W, C)
        The window.
    spacing : float
        Mean distance of the Gaussians of the whole image, in pixels.
    old : OldSet, optional
        By default the density follows the second derivatives alone.

    Returns
    -------
    ndarray of float32, shape (H, W)
    """
    density = density_from_hessian(image, spacing)
    if old is not None:
        scale_by_owner(density, nearest_center(old.mean, density.shape), old.ratio)
    return density


def place_block(
    image: Array, block: Block, count: int, spacing: float, old: OldSet | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Place and shape the Gaussians of a block.

    Parameters
    ----------
    image : ndarray, shape (H, W, C)
        The window of the block, in the space of the squared error.
    block : Block
    count : int
        Number of Gaussians, from 1 to the pixels of the core.
    spacing, old
        See `window_density`.

    Returns
    -------
    mean : ndarray, shape (count, 2)
        In pixels of the window; all lie in the core.
    factor : ndarray, shape (count, 3)
        See `eigengs_dr.Gaussians`.
    """
    density = window_density(image, spacing, old)
    rows, columns = block.core
    inside = normalize_density(density[rows, columns].copy(), count)
    density[rows, columns] = inside
    mean = lloyd_step(stratify_along_hilbert(inside, count), inside)
    mean += np.array([columns.start, rows.start])
    return mean, shapes_from_hessian(mean, density, image, spacing)


SHORT_ROUNDS, LAST_ROUNDS = 3, 5
"""Rounds of a descent without relocation, and rounds after the last relocation. More rounds lose
what the optimiser knows; fewer leave seams. On 1,024x1,024 pixels in blocks of 256, 2 to 4 short
rounds were alike, and better than 1 or 6."""


def rounds(schedule: Schedule, iterations: int) -> list[range]:
    """Return the steps of every round of a descent.

    Gaussians relocate before the first step of a round, so that neighbours do so at once and see
    each other's new places at the end of the round.

    Examples
    --------
    >>> rounds(Schedule("adam", {"color": 0.01}), 30)
    [range(0, 10), range(10, 20), range(20, 30)]
    """
    cuts = [0, *relocations(schedule, iterations)]
    number, last = LAST_ROUNDS if cuts[1:] else SHORT_ROUNDS, cuts.pop()
    number = max(1, min(number, iterations - last))
    cuts += [last + k * (iterations - last) // number for k in range(number + 1)]
    return [range(start, stop) for start, stop in pairwise(cuts)]

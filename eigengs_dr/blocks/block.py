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
from itertools import pairwise
from typing import NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import Float, types_in
from ..backend.recording import exclusive
from ..backend.selection import select
from ..fitting.density_control import Part, PartControl
from ..fitting.descent import FitProblem, run
from ..fitting.options import FitOptions
from ..fitting.placement.adaptive import density_from_hessian, place_by_density
from ..fitting.placement.density import Owners, density_ratio, squared_error
from ..fitting.placement.filters import Canvas
from ..fitting.schedule import Schedule, relocations
from ..fitting.solvers.conjugate_gradient import solve
from ..fitting.target import BRIGHT, WHITE, FitTarget, make_target, read_data, unit_of
from ..gaussian.file import SetData
from ..gaussian.gaussians import Gaussians
from ..image.pixels import ImageError
from ..raster.binning.tiles import Grid
from ..raster.render import to_tensor, to_tiles
from .draw import draw
from .grid import Block
from .windows import Window

Arrays = dict[str, NDArray[np.floating]]


class Settings(NamedTuple):
    """What all tasks of a run share.

    Attributes
    ----------
    options : FitOptions
    gaussians : int
        Number of Gaussians of all blocks.
    spacing : float
        Mean distance of the Gaussians, in pixels.
    background : tuple of float
        Value of every pixel before the Gaussians are added, in the space of the colours.
    """

    options: FitOptions
    gaussians: int
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
    """A block whose Gaussians shall be placed.

    Attributes
    ----------
    window : Window
        The pixels.
    block : Block
    gaussians : int
        From 1 to the pixels of the core.
    old : dict of str to ndarray, or None
        What a fit has shown about the density: mean (N, 2) and factor (N, 3) of the Gaussians in
        the window, in its pixels, and the ratio (N, 1), see
        `eigengs_dr.fitting.placement.density.density_ratio`. By default the density follows the
        second derivatives alone.
    """

    window: Window
    block: Block
    gaussians: int = 0
    old: Arrays | None = None


class FitTask(NamedTuple):
    """A block whose Gaussians shall be fitted.

    Attributes
    ----------
    window : Window
        The pixels.
    block : Block
    arrays : dict of str to ndarray of float32
        Mean (N, 2) and factor (N, 3) of the Gaussians whose means lie in the window, as they start;
        in pixels of the window. And their color (N, C); else a solve finds the first ones.
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
    arrays: Arrays
    own: slice
    fixed: Arrays | None
    iterations: int
    part: range


@exclusive()
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
    canvas, _, density = _density(target, settings)
    core = task.block.core
    return Surveyed(
        _mass(canvas, density, task.block),
        target.values[core].sum(axis=(0, 1), dtype=np.float64),
        unit_of(pixels, options.space),
    )


def _density(target: FitTarget, settings: Settings) -> tuple[Canvas, Float, Float]:
    """Return the canvas of a window, and squared Hessian and density on it."""
    types = types_in(select(settings.options.backend))
    canvas = Canvas.of(types, Grid(target.shown.shape[1], target.shown.shape[0]))
    image = to_tiles(types, target.shown, canvas.grid)
    return canvas, *density_from_hessian(canvas, image, settings.spacing)


def _mass(canvas: Canvas, density: Float, block: Block) -> float:
    """Return the integral of a density (pixels,) over the core of a block."""
    pixels = to_tensor(density, canvas.grid, 1).numpy()[..., 0]
    return float(pixels[block.core].sum(dtype=np.float64))


@exclusive()
def place(task: PlaceTask, settings: Settings) -> Arrays:
    """Place and shape the Gaussians of a block.

    Returns
    -------
    dict of str to ndarray
        The mean (n, 2) in pixels of the window, inside of the core, and the factor (n, 3).
    """
    options, count, spacing = settings.options, task.gaussians, settings.spacing
    canvas, energy, density = _density(make_target(task.window.read(), options.space), settings)
    types, grid = canvas.types, canvas.grid
    if task.old is not None:
        mean, factor, ratio = (task.old[name] for name in ("mean", "factor", "ratio"))
        size = grid.width, grid.height
        old = Gaussians.from_arrays(
            mean,
            factor,
            ratio,
            size=size,
            space="data",
            backend=types.backend,
            cutoff=options.cutoff,
        )
        density *= Owners.of(old).average(old.color[0])
    column, row, _, _ = canvas.pixels()
    for place, part in zip((row, column), task.block.core, strict=True):
        first, last = (dr.opaque(types.Int, edge) for edge in (part.start, part.stop))
        density = dr.select((place >= first) & (place < last), density, 0)
    mean, factor = place_by_density(canvas, density, energy, count, spacing)
    return {"mean": mean.numpy().T, "factor": factor.numpy().T}


StepDone = Callable[[int], None]
"""``step_done(step)`` every 10 steps of a fit. It may raise an error to end the fit."""


@exclusive()
def find_density(task: FitTask, settings: Settings, step_done: StepDone | None = None) -> Arrays:
    """Fit the Gaussians of a window for some steps; return the density that their errors ask for.

    Returns
    -------
    dict of str to ndarray
        Mean (n, 2) and factor (n, 3) of the own Gaussians in pixels of the window, their ratio
        (n, 1), see `PlaceTask`, and the mass (1,) of the density in the core.
    """
    target = make_target(task.window.read(), settings.options.space)
    problem = _start(task, target, settings)
    found = _descend(problem, task, settings, step_done)
    canvas, _, density = _density(target, settings)
    owners = Owners.of(found)
    error = squared_error(found, problem.target, problem.weight, owners.lists)
    ratio = density_ratio(owners, error, density)
    arrays = found.to_arrays()
    return {
        "mean": arrays["mean"][task.own],
        "factor": arrays["factor"][task.own],
        "ratio": ratio.numpy()[task.own, None],
        "mass": np.array([_mass(canvas, density * owners.average(ratio), task.block)]),
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
        before, after = (
            float(dr.sum(squared_error(g, problem.target, problem.weight))[0])
            for g in (problem.gaussians, found)
        )
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
    solved = "color" in task.arrays
    uncolored = np.zeros((len(task.arrays["mean"]), channels), np.float32)
    placed = Gaussians.from_arrays(
        task.arrays["mean"],
        task.arrays["factor"],
        task.arrays.get("color", uncolored),
        background,
        size=(width, height),
        space=options.space,
        backend=options.backend,
        cutoff=options.cutoff,
    ).bounded()
    if not solved:
        placed = solve(placed, values, options.solve_steps, background=background)
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

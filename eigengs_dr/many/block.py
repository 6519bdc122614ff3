"""The fit of one block: pure functions of pixels and numbers, which may run on any machine.

A fit works on the window of the block, with all Gaussians whose means lie in it; those that only
touch it are fixed. All of them move, but only those of the block are returned: the Gaussians of
neighbours stand in for the fits of the neighbours, which run at the same time. Between rounds of
steps, blocks exchange their Gaussians.

With a single round, no block would see the final Gaussians of its neighbours, and seams would
remain along the borders. If blocks waited for the results of their neighbours, they could not run
at the same time, and would fit to Gaussians that no longer move.

Gaussians are initialized by the adaptive placement, with one density over all blocks. Every
Gaussian belongs to one block, which places it in its core. The density also depends on the pixels
around the core, so that it is the density of the full image.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import types_in
from ..backend.selection import select
from ..backend.types import Arrays, Float, Singles
from ..fitting.channels import Channels, Target
from ..fitting.loop import descend, last
from ..fitting.method import Method
from ..fitting.objective import Objective, Part, Pixels, squares_of
from ..fitting.options import FitOptions
from ..fitting.place import (
    density_from_hessian,
    place_by_density,
    planes_of,
    shift_of,
)
from ..fitting.redistribution import Owners, density_ratio, error_by_pixel
from ..fitting.solve import solve
from ..fitting.state import State, begin
from ..gaussian.file import SetData
from ..gaussian.gaussians import Gaussians
from ..image.color import to_linear
from ..image.pixels import WHITE, ImageError
from ..image.space import DATA, YCBCR, Affine, Extent, Space
from ..raster.render import to_tiles
from .grid import Block
from .windows import Window


class BlockSettings(NamedTuple):
    """Settings that all tasks of a run share.

    Attributes
    ----------
    options : FitOptions
        Options whose space is set.
    gaussians : int
        Number of Gaussians of all blocks.
    spacing : float
        Mean distance of the Gaussians, in pixels.
    affine : Affine
        The unit of the fit.
    is_of_codes : bool
        Whether data is in [0, 1]. Otherwise the peak is the range, and psnr_rgb is NaN.
    exposure : float
        Factor of light in comparisons, see `Space.exposure`.
    background : tuple of float
        Value of every pixel before the Gaussians are added, in the unit of the fit.
    """

    options: FitOptions
    gaussians: int
    spacing: float
    affine: Affine = Affine()
    is_of_codes: bool = True
    exposure: float = 1.0
    background: tuple[float, ...] = ()

    @property
    def space(self) -> Space:
        """Space of the colours."""
        return self.options.space or YCBCR


class BlockTask(NamedTuple):
    """The work on a block.

    Attributes
    ----------
    window : Window
        The pixels: those of the window of the block, or of its core to measure errors.
    block : Block
    arrays : dict of str to ndarray of float32, or None
        Gaussians in pixels of `window`. A fit begins with mean (N, 2) and factor (N, 3) of those
        whose means lie in the window, and optionally their color (N, C); otherwise the initial
        colours are solved for. A placement takes the density of an earlier fit, if there is one:
        mean, factor, and the ratio (N, 1), see
        `eigengs_dr.fitting.redistribution.density_ratio`; otherwise the density depends on
        second derivatives only.
    gaussians : int
        Number of Gaussians to place, from 1 to the number of pixels of the core.
    members : slice
        The Gaussians of a fit that belong to the block.
    fixed : dict of str to ndarray, or None
        Mean, factor and color of other Gaussians that touch the window.
    iterations : int
        Number of steps of the complete fit.
    part : range
        The steps of this task.
    """

    window: Window
    block: Block
    arrays: Arrays | None = None
    gaussians: int = 0
    members: slice = slice(0)
    fixed: Arrays | None = None
    iterations: int = 0
    part: range = range(0)


def measure_extents(task: BlockTask, settings: BlockSettings) -> tuple[Extent, Extent]:
    """Return the extents of the values and of the light of a block, and reject invalid pixels."""
    pixels, space = task.window.read()[task.block.core], settings.space
    bright = space.above_white
    if bright is not space and task.window.encoding == "linear" and pixels.max() > WHITE:
        raise ImageError(f"{task.window.name}: light above 1; give the space {bright!r}")
    if not space.is_color:
        space.check(pixels)  # no other range makes normals
    values = Extent.of(space.values_of(pixels))
    return values, values if space.bounded else Extent.of(to_linear(pixels))


def survey(task: BlockTask, settings: BlockSettings) -> NDArray[np.float64]:
    """Return the number of Gaussians that a block needs, relative to others, and its sums.

    These are the integral of the density over the core, and the sum of the values of each channel.
    """
    objective = _objective(task, settings)
    _, density = _density(objective, settings)
    values = objective.picture(objective.model.target).numpy()[task.block.core]
    total = values.sum(axis=(0, 1), dtype=np.float64)
    return np.append(_mass(density, task.block), total)


def _objective(task: BlockTask, settings: BlockSettings) -> Pixels:
    """Return the objective of a window."""
    types = types_in(select(settings.options.backend))
    target = Target.of(task.window.read(), settings.space, settings.affine)
    part = slice(0, target.pixels.shape[2])
    return squares_of([Channels("", settings.space, part, (target,))], types)


def _density(objective: Pixels, settings: BlockSettings) -> tuple[Singles, Singles]:
    """Return the squared Hessian (3, H, W) of a window, and the density (H, W)."""
    [image] = planes_of(objective.placement_image, objective.grid)
    return density_from_hessian(image, settings.spacing)


def _mass(density: Singles, block: Block) -> float:
    """Return the integral of a density over the core of a block."""
    return float(density[block.core].sum(dtype=np.float64))


def place_in_block(task: BlockTask, settings: BlockSettings) -> Arrays:
    """Place and shape the Gaussians of a block.

    Returns
    -------
    dict of str to ndarray
        The mean (n, 2), in pixels of the window and inside the core, and the factor (n, 3).
    """
    objective = _objective(task, settings)
    energy, density = _density(objective, settings)
    if task.arrays is not None:
        arrays = task.arrays | {"color": task.arrays["ratio"]}
        old = _set_of(arrays, objective.size, DATA, settings)
        density *= _at_pixels(Owners.of(old), old.color[0])
    core = np.zeros_like(density)
    core[task.block.core] = density[task.block.core]
    shift = shift_of(settings.options.seed)
    mean, factor = place_by_density(core, energy, task.gaussians, settings.spacing, shift)
    return {"mean": mean.astype(np.float32), "factor": factor.astype(np.float32)}


def _at_pixels(owners: Owners, ratio: Float) -> Singles:
    """Return the ratio (N,) of Gaussians at the pixels that they own, (H, W)."""
    return planes_of(owners.average(ratio), owners.lists.grid)[0, 0]


StepDone = Callable[[int], None]
"""``step_done(step)`` is called every 10 steps of a fit. It may raise an error to end the fit."""


def find_density(
    task: BlockTask, settings: BlockSettings, step_done: StepDone | None = None
) -> Arrays:
    """Fit the Gaussians of a window for some steps; return the density that their errors suggest.

    Returns
    -------
    dict of str to ndarray
        Mean (n, 2) and factor (n, 3) of the Gaussians of the block in pixels of the window, their
        ratio (n, 1), see `BlockTask`, and the mass (1,) of the density in the core.
    """
    full = _objective(task, settings)
    objective, start = _start(task, full, settings)
    fitted = _descend(objective, start, task, settings, step_done)
    _, density = _density(full, settings)
    owners = Owners.of(fitted)
    error = error_by_pixel(fitted, objective, owners.lists)
    ratio = density_ratio(owners, error, to_tiles(full.types, density[..., None]))
    arrays = fitted.to_arrays()
    return {
        "mean": arrays["mean"][task.members],
        "factor": arrays["factor"][task.members],
        "ratio": ratio.numpy()[task.members, None],
        "mass": np.array([_mass(density * _at_pixels(owners, ratio), task.block)]),
    }


def fit_block(
    task: BlockTask, settings: BlockSettings, step_done: StepDone | None = None
) -> Arrays:
    """Take some steps of the fit of a window, and return the Gaussians of its block.

    Returns
    -------
    dict of str to ndarray
        Mean, factor and color of the Gaussians of the block, in pixels of the window.
    """
    objective, start = _start(task, _objective(task, settings), settings)
    part = Part(task.members, task.block.core)
    fitted = _descend(replace(objective, part=part), start, task, settings, step_done)
    if task.part.stop == task.iterations:
        # Only the last steps are undone if they increase the error, as for a nearly perfect set;
        # earlier steps may increase it temporarily.
        before, after = (float(dr.sum(error_by_pixel(g, objective))[0]) for g in (start, fitted))
        fitted = fitted if after < before else start
    arrays = fitted.to_arrays()
    return {name: arrays[name][task.members] for name in ("mean", "factor", "color")}


def _start(task: BlockTask, objective: Pixels, settings: BlockSettings) -> tuple[Pixels, Gaussians]:
    """Return the objective minus the fixed Gaussians, and the others with initial colours."""
    if task.fixed is not None and len(task.fixed["mean"]):
        fixed = _set_of(task.fixed, objective.size, settings.space, settings)
        objective = objective.minus(fixed)
    assert task.arrays is not None
    unset = {
        "color": np.zeros((len(task.arrays["mean"]), objective.channels), np.float32),
        "background": np.array(settings.background, np.float32),
    }
    placed = _set_of(unset | task.arrays, objective.size, settings.space, settings).bounded()
    if "color" not in task.arrays:
        steps = settings.options.method.solve_steps
        placed = solve(placed, objective, steps, warm_start=True, held=True)
    return objective, placed


def _set_of(
    arrays: Arrays, size: tuple[int, int], space: Space, settings: BlockSettings
) -> Gaussians:
    """Return Gaussians in pixels of a window as a set."""
    data = SetData(arrays, size, space, settings.options.method.cutoff)
    return Gaussians.from_data(data, settings.options.backend)


def _descend(
    objective: Pixels,
    start: Gaussians,
    task: BlockTask,
    settings: BlockSettings,
    step_done: StepDone | None,
) -> Gaussians:
    """Take the steps of a task, with the controls of the method if the objective has a part."""
    method, seed = settings.options.method.without("redistribute"), settings.options.seed
    if objective.part is None:
        method = replace(method, controls=())

    def states() -> Generator[State, None, None]:
        steps = descend(
            Objective(objective), method, begin(start), task.iterations, seed, task.part
        )
        for taken, state in enumerate(steps, 1):
            if step_done and taken % 10 == 0:
                dr.sync_thread()  # steps run asynchronously
                step_done(taken)
            yield state

    return last(states(), start)


SHORT_ROUNDS, LAST_ROUNDS = 3, 5
"""Number of rounds of a descent without relocation, and of rounds after the last relocation. More
rounds lose the state of the optimiser; fewer leave seams. On 1,024x1,024 pixels in blocks of 256, 2
to 4 short rounds were equally good, and better than 1 or 6."""


def exchange_rounds(method: Method, iterations: int) -> list[range]:
    """Return the steps of each round of a descent.

    Gaussians relocate before the first step of a round, so that neighbours relocate at the same
    time and see each other's new positions at the end of the round.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> exchange_rounds(eg.DEFAULT, 30)
    [range(0, 10), range(10, 20), range(20, 30)]
    """
    cuts = sorted({0, *method.steps_in("relocate", iterations)})
    number, latest = LAST_ROUNDS if cuts[1:] else SHORT_ROUNDS, cuts.pop()
    number = max(1, min(number, iterations - latest))
    cuts += [latest + k * (iterations - latest) // number for k in range(number + 1)]
    return [range(start, stop) for start, stop in pairwise(cuts)]

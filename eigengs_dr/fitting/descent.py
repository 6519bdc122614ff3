"""Gradient descent on all parameters of the Gaussians of one image.

A step takes three kernels: the sum over Gaussians, which writes the derivative of the error instead
of an image; the adjoint; and the optimiser, with one lane per Gaussian.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, TypeAlias

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import ArrayTypes, Float, UInt, make_divisor, types_of, upload
from ..backend.recording import freeze_program, release_later
from ..gaussian.gaussians import Gaussians, take
from ..raster.adjoint import adjoint_pieces, sum_pieces
from ..raster.binning.lists import TileLists
from ..raster.kernels import residual, sum_lanes
from ..raster.parameters import NUM_SHAPE_PARAMS, kernel_radius, kernel_shape, pack_parameters
from ..raster.render import batch_to_tiles, bin_gaussians
from .parameterization import Parameterization, Variables
from .schedule import (
    Relocation,
    Schedule,
    first_phase,
    lr_factor,
    next_build,
    relocations,
    surplus_for,
)

MSE_EPSILON = 1e-10
"""Mean squared error added before the logarithm, which would diverge at an error of 0."""


class TiledImage(NamedTuple):
    """The image of a descent on the device, or a batch of images.

    Attributes
    ----------
    values : Float
        In the space of the set, in the tile layout of `eigengs_dr.raster.kernels`.
    weight : Float, or None
        Factor of the errors before squaring, in tile layout.
    lists : TileLists, or None
        Lists that are valid for the current set; None if there are none yet.
    """

    values: Float
    weight: Float = None
    lists: TileLists | None = None


class Control(Protocol):
    """The density control of a descent: Gaussians that are placed anew, move and leave.

    `eigengs_dr.fitting.density_control` has those of one image and of levels.
    """

    @property
    def redistributes(self) -> bool:
        """Whether all Gaussians are placed anew after a first phase."""

    def redistribute(self, gaussians: Gaussians, count: int) -> Gaussians:
        """Return a new set of `count` Gaussians, denser where the old set left more error."""

    def relocate(self, gaussians: Gaussians, how: Relocation, image: TiledImage) -> Gaussians:
        """Return as many Gaussians, less those that `how` drops.

        Some have moved to where the old set left most error, and all are perturbed.
        """


StepProgram: TypeAlias = Callable[..., "Descent"]
"""One step of a descent, see `step_program`."""


class FitProblem(NamedTuple):
    """The start and the target of a descent.

    Attributes
    ----------
    gaussians : Gaussians
        The set before the first step.
    target : ndarray of float32, shape (H, W, C)
        The image in the space of the set. For a batch, (M, H, W, C): the set holds the Gaussians of
        all images, image after image, and its background has M values.
    weight : ndarray of float32, shape (H, W, C), or None
        Factor of the errors before squaring.
    control : Control, or None
        None where Gaussians must keep their places.
    """

    gaussians: Gaussians
    target: NDArray[np.float32]
    weight: NDArray[np.float32] | None = None
    control: Control | None = None


def run(
    problem: FitProblem,
    schedule: Schedule,
    iterations: int,
    after: Callable[[int, Gaussians], bool] | None = None,
    *,
    levels: Sequence[int] = (),
    surplus: int = 0,
    part: range | None = None,
) -> Gaussians:
    """Take the steps of `descend`, to the last one or until `after` ends it.

    Parameters
    ----------
    problem, schedule, iterations, levels, surplus, part
        See `descend`.
    after : callable, optional
        ``after(step, gaussians)`` with the set before the first step, as step 0, and after every
        step. True ends the descent; it may raise an error to do so.

    Returns
    -------
    Gaussians
        The last set, without gradients.
    """
    sets = descend(problem, schedule, iterations, levels=levels, surplus=surplus, part=part)
    with closing(sets):
        for step, found in enumerate(sets):
            if after and after(step, found):
                break
    return dr.detach(found)


def descend(
    problem: FitProblem,
    schedule: Schedule,
    iterations: int,
    *,
    levels: Sequence[int] = (),
    surplus: int = 0,
    part: range | None = None,
) -> Generator[Gaussians, None, None]:
    """Yield the set before the first step and after every step of gradient descent.

    Parameters
    ----------
    problem : FitProblem
        The start and the target. With a control, Gaussians move between steps, see `relocations`.
        If it redistributes, a first phase shows where error is left, and the other steps start
        from redistributed Gaussians, see `first_phase`; there are more Gaussians until the last of
        the moves, see `surplus_for`. These functions are in `eigengs_dr.fitting.schedule`.
    schedule : Schedule
    iterations : int
        Number of steps, with the first phase.
    levels : sequence of int, optional
        Numbers n. The first n Gaussians shall form the image too, as well as they can.
    surplus : int, optional
        Number of Gaussians of each image that relocations, if there are any, drop from the start.
        A descent that redistributes has none, and gets its own.
    part : range, optional
        The steps to take, some of ``range(iterations)``, without a first phase; by default all. A
        part starts without the moments of the optimiser. It starts with a warm-up, unless Gaussians
        relocate before its first step: without one, a stop in the middle of 100 steps costs 0.55
        dB, with one 0.16 dB (1,024x1,024 pixels, one Gaussian for 20 pixels).

    Yields
    ------
    Gaussians
        The current set. After the last relocation it has as many Gaussians as the start, less the
        argument `surplus`. Steps run asynchronously: its arrays may not be computed yet.
    """
    with release_later(problem):  # a set of the caller may share NumPy's memory
        yield problem.gaussians
        first = 0 if part is not None else first_phase(schedule, iterations)
        if problem.control and problem.control.redistributes and first:
            for current in _run_phase(problem, schedule, range(first), first):
                yield current
            iterations, images = iterations - first, number_of_images(problem)
            count, pixels = len(current) // images, current.width * current.height
            surplus = surplus_for(schedule, count, pixels, iterations)
            anew = problem.control.redistribute(dr.detach(current), len(current) + images * surplus)
            problem = problem._replace(gaussians=anew)
        part = range(iterations) if part is None else part
        yield from _run_phase(problem, schedule, part, iterations, levels, surplus)


def number_of_images(problem: FitProblem) -> int:
    """Return how many images a problem has: more than one for a batch."""
    return len(problem.target) if problem.target.ndim == 4 else 1


def _run_phase(
    problem: FitProblem,
    schedule: Schedule,
    part: range,
    iterations: int,
    levels: Sequence[int] = (),
    surplus: int = 0,
) -> Generator[Gaussians, None, None]:
    """Yield the set after every step of a part of a phase of so many iterations."""
    fixed = problem.gaussians
    types = types_of(fixed.mean)
    images = number_of_images(problem)
    state, variables = start_descent(fixed, schedule, images), schedule.variables()
    target = batch_to_tiles(types, problem.target)
    weight = None if problem.weight is None else batch_to_tiles(types, problem.weight)
    moves_at = relocations(schedule, iterations, surplus) if problem.control else {}
    start = 0 if part.start in moves_at else part.start
    factors = [lr_factor(schedule, step, iterations, start) for step in range(iterations)]
    rates, stop = rate_table(types, schedule, factors), part.start
    lists: list[TileLists] = []
    with freeze_program(step_program(schedule, fixed, levels)) as take_step:
        for step in part:
            if step in moves_at and problem.control:
                image = TiledImage(target, weight, lists[-1] if lists else None)
                current = dr.detach(state.gaussians)
                fixed = problem.control.relocate(current, moves_at[step], image)
                state, stop = start_descent(fixed, schedule, images), step
            if step == stop:
                end = min((s for s in moves_at if s > step), default=part.stop)
                stop, moves = next_build(schedule, step, iterations, min(end, part.stop))
                pad, growth = variables.reach(fixed, moves)
                pad = pad if state.rate_scale is None else pad * state.rate_scale
                counts, lists = (*levels, len(fixed)), []  # old lists make room for new ones
                lists = [
                    bin_gaussians(
                        prefix(state.gaussians, n), _prefix(pad, n), growth, images=images
                    )
                    for n in counts
                ]
            index = dr.opaque(types.UInt, step)
            state = take_step(
                replace(state, gaussians=None), fixed, target, weight, lists, rates, index
            )
            yield state.gaussians


def rate_table(types: ArrayTypes, schedule: Schedule, factors: Sequence[float]) -> Float:
    """Return the learning rates of all steps, step after step, as Float."""
    table = np.outer(factors, list(schedule.rates.values()))
    return upload(types.Float, table.ravel().astype(np.float32 if types.bits == 32 else np.float64))


def step_program(schedule: Schedule, like: Gaussians, levels: Sequence[int] = ()) -> StepProgram:
    """Make the function of one step for `eigengs_dr.backend.recording.freeze_program`.

    Dr.Jit traces the function once and replays it without Python. The program belongs to one run: a
    replay does not notice other settings, such as the betas of another optimiser.

    Parameters
    ----------
    schedule : Schedule
    like : Gaussians
        A set with the channels of the image.
    levels : sequence of int, optional
        As for `descend`.

    Returns
    -------
    callable
        ``step(state, fixed, target, weight, lists, rates, index) -> state`` for a `Descent`; it
        descends on the mean squared error, then projects the variables into their bounds.
    """
    coordinates, optimizer = schedule.variables(), schedule.make_optimizer()
    channels = like.channels

    def step(
        state: Descent,
        fixed: Gaussians,
        target: Float,
        weight: Float,
        lists: list[TileLists],
        rates: Float,
        index: UInt,
    ) -> Descent:
        radius = kernel_radius(fixed.cutoff)
        gradient: list = []
        for listed in lists:
            delta, squares = residual(
                state.packed, list(fixed.background), listed, radius, target, weight
            )
            parts = adjoint_pieces(state.packed, delta, channels, listed, radius)
            dr.eval(parts)
            number = listed.sizes.width * listed.sizes.height * channels
            factor = 2 / number
            if levels:
                # The sum of the logarithms of the errors, so that no level suffers for another.
                mean = sum(sum_lanes(squares, listed)) / number
                factor = factor / (mean + MSE_EPSILON)
            sums = _sum_level(parts, listed, channels, len(fixed))
            before = gradient or [0.0] * len(sums)
            gradient = [g + s * factor for g, s in zip(before, sums, strict=True)]
        sizes = lists[0].sizes
        return _move(state, fixed, gradient, rates, index, (sizes.width, sizes.height))

    def _move(
        state: Descent, fixed: Gaussians, gradient: Float, rates: Float, index: UInt, size: tuple
    ) -> Descent:
        """Take the step of the optimiser; all of it is one kernel with a lane per Gaussian."""
        Float = type(state.packed)
        slopes = _pull_back(coordinates, fixed, state.variables, gradient, size)
        variables, moments = {}, {}
        for k, name in enumerate(schedule.rates):
            rate = dr.gather(Float, rates, index * len(schedule.rates) + k)
            if state.rate_scale is not None and name != "color":
                rate *= state.rate_scale
            variables[name], moments[name] = optimizer.step(
                state.variables[name], slopes[name], state.moments[name], rate, Float(index) + 1
            )
        variables = coordinates.project(fixed, variables, size)
        moved = coordinates.decode(fixed, variables, size)
        return Descent(variables, moments, moved, pack(moved), state.rate_scale)

    return step


def _sum_level(parts: Float, lists: TileLists, channels: int, count: int) -> list:
    """Return the gradient of `count` Gaussians; it is 0 for those that the lists do not hold."""
    assert lists.pieces is not None
    splat = None
    if count != dr.width(lists.pieces.first):
        splat = dr.arange(dr.uint32_array_t(type(parts)), count)
    return sum_pieces(parts, lists.pieces, NUM_SHAPE_PARAMS + channels, splat)


def _pull_back(
    coordinates: Parameterization,
    fixed: Gaussians,
    variables: Variables,
    gradient: list,
    size: tuple,
) -> Variables:
    """Return the gradient with respect to variables, from that of the kernels' parameters."""
    with dr.resume_grad():
        traced = {name: type(value)(value) for name, value in variables.items()}
        dr.enable_grad(traced)
        decoded = coordinates.decode(fixed, traced, size)
        rows = [*kernel_shape(decoded), *decoded.color]
        known = [(row, g) for row, g in zip(rows, gradient, strict=True) if dr.grad_enabled(row)]
        for row, g in known:
            dr.set_grad(row, g)
        dr.enqueue(dr.ADMode.Backward, [row for row, _ in known])
        dr.traverse(dr.ADMode.Backward)
        return {name: dr.grad(value) for name, value in traced.items()}


def _prefix(pad: Float, count: int) -> Float:
    """Return the first `count` entries of an array, or a number as it is."""
    if isinstance(pad, float) or dr.width(pad) in (1, count):
        return pad
    return dr.gather(type(pad), pad, dr.arange(dr.uint32_array_t(type(pad)), count))


def prefix(gaussians: Gaussians, count: int) -> Gaussians:
    """Return the first `count` Gaussians of a set, differentiably, also in a frozen program."""
    if count == len(gaussians):
        return gaussians
    return take(gaussians, dr.arange(types_of(gaussians.mean).UInt, count))


@dataclass(frozen=True)
class Descent:
    """The state of a descent.

    Attributes
    ----------
    variables : dict of str to arrays
        The variables that the optimiser moves.
    moments : dict of str to tuple
        The state of the optimiser for each variable.
    gaussians : Gaussians or None
        The set of these variables. A step does not need it, and each array that a frozen program
        gets costs a microsecond.
    packed : Float
        The parameters of this set for the kernels.
    rate_scale : Float or None
        Factor of the learning rates of means and shapes, one for each Gaussian.
    """

    variables: Variables
    moments: dict[str, tuple]
    gaussians: Any
    packed: Float
    rate_scale: Float = None


def start_descent(gaussians: Gaussians, schedule: Schedule, images: int = 1) -> Descent:
    """Return the state before the first step, for the Gaussians of one image after another."""
    encoded, optimizer = schedule.variables().encode(gaussians), schedule.make_optimizer()
    variables = {name: dr.detach(encoded[name]) for name in schedule.rates}
    dr.eval(variables)
    moments = {name: optimizer.start(value) for name, value in variables.items()}
    rate_scale = None
    if schedule.rate_exponent:
        zeros = dr.zeros(types_of(gaussians.mean).Float, len(gaussians))
        color = [dr.detach(row) + zeros for row in gaussians.color]
        rate_scale = rate_scale_of(color, schedule.rate_exponent, images)
        dr.eval(rate_scale)
    return Descent(variables, moments, gaussians, pack(gaussians), rate_scale)


MAX_RATE_SCALE = 1.7
"""How much faster or slower than the others a Gaussian may move."""


def rate_scale_of(color: list, exponent: float, images: int = 1) -> Float:
    """Return factors of learning rates for the Gaussians of one image after another.

    The error depends most on bright Gaussians, so they move less. With the length of a colour |c|,
    the factor is ``(mean |c| / |c|)^exponent``, at most `MAX_RATE_SCALE` and at least its inverse.
    The mean is that of the own image.

    Parameters
    ----------
    color : list of Float, shape (N,)
        By channels.
    exponent : float
    images : int, optional

    Returns
    -------
    Float, shape (N,)
        1 if all colours are 0.
    """
    types = types_of(color[0])
    length = dr.sqrt(sum(dr.square(row) for row in color))
    count = dr.width(length) // images
    mean = dr.sum(length)
    if images > 1:
        own, _ = make_divisor(types, count).divmod(dr.arange(types.UInt, dr.width(length)))
        mean = dr.gather(types.Float, dr.block_sum(length, count), own)
    mean *= dr.opaque(types.Float, 1 / count)
    ratio = dr.select(mean > 0, mean / length, types.Float(1))
    bound = MAX_RATE_SCALE ** (1 / exponent)
    return dr.clip(ratio, 1 / bound, bound) ** exponent


def pack(gaussians: Gaussians) -> Float:
    """Return the parameters of a set for the kernels, in their layout in memory."""
    return pack_parameters([*kernel_shape(gaussians), *gaussians.color])

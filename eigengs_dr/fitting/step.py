"""One step of a descent: its learning rates, its tile lists and its program.

A step takes three kernels, with levels two more for each: the sum over Gaussians, which writes the
derivative of the objective instead of an image; the adjoint; and the optimiser, with one lane per
Gaussian. `eigengs_dr.fitting.loop.descend` takes the steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import drjit as dr

from ..backend.arrays import make_divisor, types_of
from ..backend.types import Float, FloatLike, Mask
from ..gaussian.gaussians import Gaussians, broadcast_rows, take
from ..raster.adjoint import adjoint_pieces, sum_pieces
from ..raster.kernels import sum_lanes
from ..raster.lists import TileLists
from ..raster.parameters import NUM_SHAPE_PARAMS, kernel_radius, kernel_shape, pack_parameters
from ..raster.render import bin_gaussians
from .loss import Slope
from .method import Method, Schedule
from .objective import Pixels, Quadratic
from .state import Coordinates, Moving, State, Variables

SMALL_IMAGE = 96 * 96
"""Largest number of pixels of an image whose lists last longer, as a build takes as long as many
steps."""

SMALL_IMAGE_DRIFT = 1.6
"""Factor of `Method.drift` for such images: fits of 64x64 pixels take 14 % less time, of 96x96 6 %
less, with the same PSNR; 2.1 gains no more, and slows batches."""

LOSS_EPSILON = 1e-10
"""Mean loss added before the logarithm of a level, which would diverge at 0."""


def started(state: State, method: Method, step: int, images: int = 1) -> State:
    """Return the state in which the optimiser starts at the current set, before a step."""
    gaussians = dr.detach(state.gaussians)
    encoded = method.coordinates.encode(gaussians)
    if unknown := set(method.rates) - set(encoded):
        raise ValueError(f"rates name {min(unknown)!r}; the variables are {', '.join(encoded)}")
    variables = {name: dr.detach(encoded[name]) for name in method.rates}
    shape = kernel_shape(gaussians)
    dr.eval(variables, shape)
    moments = {name: method.optimizer.start(value) for name, value in variables.items()}
    types, scale = types_of(gaussians.mean), None
    if method.rate_exponent:
        scale = rate_scale_of(
            broadcast_rows(gaussians.color, gaussians), method.rate_exponent, images
        )
        dr.eval(scale)
    time = dr.opaque(types.Float, 0)
    packed = pack_parameters([*shape, *gaussians.color])
    moving = Moving(variables, moments, time, packed, scale)
    return replace(state, fixed=gaussians, moving=moving, since=step, lists=())


def listed(
    state: State,
    objective: Pixels,
    method: Method,
    schedule: Schedule,
    step: int,
    end: int,
) -> State:
    """Make the tile lists of the current set, which last until `end` or until it moves too far."""
    assert state.fixed is not None and state.moving is not None
    drift, total, until = method.drift / max(method.rates.values()), 0.0, step
    if math.prod(objective.size) <= SMALL_IMAGE:
        drift *= SMALL_IMAGE_DRIFT
    while until < end:
        factor = schedule.rate(until, state)
        if until > step and total + factor > drift:
            break
        total, until = total + factor, until + 1
    moves = {name: rate * total for name, rate in method.rates.items()}
    pad, growth = method.coordinates.reach(state.fixed, moves)
    if state.moving.rate_scale is not None:
        pad *= state.moving.rate_scale
    counts, gaussians = (*objective.levels, len(state.gaussians)), state.gaussians
    state = replace(state, lists=())  # old lists make room for new ones
    images = objective.grid.images
    lists = tuple(_lists_of_first(n, gaussians, pad, growth, images) for n in counts)
    return replace(state, lists=lists, until=until)


def _lists_of_first(
    count: int, gaussians: Gaussians, pad: FloatLike, growth: float, images: int
) -> TileLists:
    """Return the lists of the first `count` Gaussians; `pad` has a number for each, or one."""
    if count < len(gaussians):
        first = dr.arange(types_of(gaussians.mean).UInt, count)
        gaussians = take(gaussians, first)
        if not isinstance(pad, float) and dr.width(pad) > 1:
            pad = dr.gather(type(pad), pad, first)
    return bin_gaussians(gaussians, pad, growth, images=images)


StepProgram: TypeAlias = Callable[..., tuple[Moving, Gaussians]]
"""One step of a descent, see `step_program`."""


def step_program(objective: Pixels, method: Method) -> StepProgram:
    """Make the function of one step for `eigengs_dr.backend.recording.freeze_program`.

    Dr.Jit traces the function once and replays it without Python. The program belongs to one run: a
    replay does not notice other settings, such as the betas of another optimiser.

    Returns
    -------
    callable
        ``step(largest, moving, fixed, model, lists, rates) -> moving, gaussians``: it
        descends on the mean of ``h (p - t)^2``, then projects the variables into their bounds. With
        levels it descends on the sum of the logarithms of these means for the prefixes of the set,
        so that no level suffers for another. `largest` is the largest number of Gaussians so far:
        each has its own program, since Dr.Jit 1.5 writes beyond arrays if a program is replayed for
        more Gaussians than it was recorded for. `rates` holds that of each variable at this step.
    """
    channels, levels = objective.channels, bool(objective.levels)

    def step(
        largest: int,
        moving: Moving,
        fixed: Gaussians,
        model: Quadratic | Slope,
        lists: list[TileLists],
        rates: Float,
    ) -> tuple[Moving, Gaussians]:
        radius, background = kernel_radius(fixed.cutoff), list(fixed.background)
        gradient: list = []
        for listed in lists:
            delta, squares = model.compare(moving.packed, background, listed, radius, pairs=True)
            parts = adjoint_pieces(moving.packed, delta, channels, listed, radius)
            dr.eval(parts)
            number = listed.layout.width * listed.layout.height * channels
            factor = 2 / number
            if levels:
                factor = factor / (sum(sum_lanes(squares, listed)) / number + LOSS_EPSILON)
            sums = _sum_level(parts, listed, channels, len(fixed))
            before = gradient or [0.0] * len(sums)
            gradient = [g + s * factor for g, s in zip(before, sums, strict=True)]
        size = lists[0].layout.width, lists[0].layout.height
        rests = model.size == 0 if isinstance(model, Slope) else None
        return _move(method, moving, fixed, gradient, rates, size, rests)

    return step


def _move(
    method: Method,
    moving: Moving,
    fixed: Gaussians,
    gradient: list,
    rates: Float,
    size: tuple,
    rests: Mask | None,
) -> tuple[Moving, Gaussians]:
    """Take the step of the optimiser; all of it is one kernel with a lane per Gaussian.

    Nothing moves, nor does the optimiser's state, if it `rests`.
    """
    Float, coordinates = type(moving.packed), method.coordinates
    slopes = _pull_back(coordinates, fixed, moving.variables, gradient, size)
    time = moving.time + 1
    variables, moments = {}, {}
    for k, name in enumerate(method.rates):
        rate = dr.gather(Float, rates, k)
        if moving.rate_scale is not None and name != "color":
            rate *= moving.rate_scale
        variables[name], moments[name] = method.optimizer.step(
            moving.variables[name], slopes[name], moving.moments[name], rate, time
        )
    if rests is not None:
        before = moving.variables, moving.moments, moving.time
        variables, moments, time = dr.select(rests, before, (variables, moments, time))
    variables = coordinates.project(fixed, variables, size)
    moved = coordinates.decode(fixed, variables, size)
    packed = pack_parameters([*kernel_shape(moved), *moved.color])
    return Moving(variables, moments, time, packed, moving.rate_scale), moved


def _sum_level(parts: Float, lists: TileLists, channels: int, count: int) -> list:
    """Return the gradient of `count` Gaussians; it is 0 for those that the lists do not hold."""
    assert lists.pieces is not None
    splat = None
    if count != dr.width(lists.pieces.first):
        splat = dr.arange(dr.uint32_array_t(type(parts)), count)
    return sum_pieces(parts, lists.pieces, NUM_SHAPE_PARAMS + channels, splat)


def _pull_back(
    coordinates: Coordinates,
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
        pairs = [(row, g) for row, g in zip(rows, gradient, strict=True) if dr.grad_enabled(row)]
        for row, g in pairs:
            dr.set_grad(row, g)
        dr.enqueue(dr.ADMode.Backward, [row for row, _ in pairs])
        dr.traverse(dr.ADMode.Backward)
        return {name: dr.grad(value) for name, value in traced.items()}


MAX_RATE_SCALE = 1.7
"""How much faster or slower than the others a Gaussian may move."""


def rate_scale_of(color: Sequence[Float], exponent: float, images: int = 1) -> Float:
    """Return factors of learning rates for the Gaussians of one image after another.

    The error depends most on bright Gaussians, so they move less. With the length of a colour |c|,
    the factor is ``(mean |c| / |c|)^exponent``, at most `MAX_RATE_SCALE` and at least its inverse.
    The mean is over the Gaussians of the same image.

    Parameters
    ----------
    color : sequence of Float, shape (N,)
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
        image, _ = make_divisor(types, count).divmod(dr.arange(types.UInt, dr.width(length)))
        mean = dr.gather(types.Float, dr.block_sum(length, count), image)
    mean *= dr.opaque(types.Float, 1 / count)
    ratio = dr.select(mean > 0, mean / length, types.Float(1))
    bound = MAX_RATE_SCALE ** min(1 / exponent, 150)  # as single precision holds it
    return dr.clip(ratio, 1 / bound, bound) ** exponent

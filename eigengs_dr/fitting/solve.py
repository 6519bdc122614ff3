"""The best colours for fixed shapes: linear least squares by preconditioned conjugate gradients.

A rendering is linear in colours and background. Column n of the matrix ``A`` holds the weights of
Gaussian n at all pixels; the last column is 1. The best colours c minimise ``sum h (A c - D)^2``
for the image D and the curvature h of an objective, see `eigengs_dr.fitting.objective.Quadratic`. A
rendering computes a product with A, an adjoint a product with its transpose; A is never stored.
With the diagonal matrix H of the curvature, the normal equations are ``A^T H A c = A^T H D``.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr

from ..backend.arrays import rcp, release_memory, types_of
from ..backend.recording import record
from ..backend.types import Float, UInt
from ..gaussian.gaussians import Gaussians, broadcast_rows
from ..raster.adjoint import adjoint
from ..raster.kernels import channel_sums, difference, image_of, spread, sum_by_image
from ..raster.lists import TileLists
from ..raster.parameters import (
    detached_shape,
    gather_run,
    kernel_radius,
    pack_parameters,
)
from ..raster.render import bin_gaussians
from ..raster.tiles import Grid
from .objective import Pixels, Quadratic

RELATIVE_TOLERANCE = {32: 1e-12, 64: 1e-28}
"""Tolerance by the bits of a float: a channel stops if ``r^T z``, relative to its first value, is
smaller. A smaller ``r^T z`` is only rounding."""

ROUNDING = {32: 2e-7, 64: 4e-16}
"""Relative error of a correlation with a Gaussian, by the bits of a float. A channel that started
with the error e stops too if ``r^T z`` is below ``N ROUNDING^2 |e|^2``, which is only rounding."""


Unknowns = tuple[list, list]
"""Colours of all Gaussians and backgrounds of all images: a Float for each channel in both."""

State = tuple[Unknowns, Unknowns, Unknowns, list]
"""The unknowns x, the direction p, ``r = A^T (D - A x)``, and ``r^T z`` with ``z`` = r times the
preconditioner."""


def solve(
    gaussians: Gaussians,
    objective: Pixels,
    steps: int = 10,
    warm_start: bool = False,
    held: bool = False,
) -> Gaussians:
    """Find the colours and the background that fit an image best on fixed shapes.

    The method is conjugate gradients on the normal equations, for each channel separately, with
    their diagonal ``sum_x h(x) w_n(x)^2`` as preconditioner. A step costs one rendering and one
    adjoint with respect to colours.

    Parameters
    ----------
    gaussians : Gaussians
        For a batch, those of all images, image after image, equally many for each.
    objective : Pixels
        The image and its weights. Each image of a batch has its own step lengths.
    steps : int, optional
        Number of steps. Few steps regularise the colours of Gaussians that overlap strongly.
    warm_start : bool, optional
        Start from the colours and background of the set instead of zero and the mean of the image.
    held : bool, optional
        Whether a warm start keeps its background.

    Returns
    -------
    Gaussians
        The set with the new colours and background; for a batch, a background for each image. A
        step never adds to the error ``sum h (A c - D)^2``, except by rounding.

    Raises
    ------
    ValueError
        If image and set differ in shape, or steps is negative.
    """
    needed = (gaussians.width, gaussians.height, gaussians.channels)
    if (*objective.size, objective.channels) != needed:
        given = (*objective.size, objective.channels)
        raise ValueError(f"solve: the image has width, height, channels {given}, the set {needed}")
    if steps < 0:
        raise ValueError(f"solve: steps is {steps}; it must be at least 0")
    with dr.suspend_grad():
        cutoff, model, values = gaussians.cutoff, objective.model, dr.width(objective.model.target)
        lists = bin_gaussians(gaussians, images=objective.grid.images)
        shape = detached_shape(gaussians)
        types = types_of(gaussians.mean)
        if warm_start:
            x = colors_of(gaussians)
        else:
            color = [dr.zeros(types.Float, len(gaussians)) for _ in range(gaussians.channels)]
            x = color, model.mean_target(objective.grid, gaussians.channels)
        dr.make_opaque(shape, x)
        inverse, enough, state = _begin(shape, x, model, held, lists, cutoff)
        release_memory(values)  # memory of the lists and the start would stay reserved
        for _ in range(steps):
            state = _step(shape, state, model.curvature, enough, inverse, lists, cutoff)
        best, free = map(types.FloatX, state[0])
        solved = replace(gaussians, color=best, background=free)
        dr.eval(solved)
        del lists
    release_memory(values)
    return solved


def colors_of(gaussians: Gaussians) -> Unknowns:
    """Return the colours of a set and its backgrounds, without derivatives."""
    color, background = dr.detach(gaussians.color), dr.detach(gaussians.background)
    return broadcast_rows(color, gaussians), list(background)


@record
def _begin(
    shape: list, x: Unknowns, model: Quadratic, held: bool, lists: TileLists, cutoff: float
) -> tuple[Unknowns, list, State]:
    """Return the preconditioner, the ``r^T z`` at which channels stop, and the first state.

    A held background keeps its value.
    """
    channels, grid, types = len(x[0]), lists.grid, types_of(model.target)
    packed = pack_parameters([*shape, *x[0]])
    error, squares = apply(packed, x[1], lists, cutoff, model)
    color, diagonal = weigh(packed, error, channels, lists, cutoff, model.curvatures(grid))
    inverse = preconditioner(diagonal, channels)
    inverse = held_background(inverse) if held else inverse
    r = negate((color, channel_sums(error, channels, grid)))
    p = multiply(r, inverse)
    rz = dots(r, p, grid)
    noise = dr.opaque(types.Float, dr.width(shape[0]) / grid.images * ROUNDING[types.bits] ** 2)
    enough = [
        dr.maximum(RELATIVE_TOLERANCE[types.bits] * a, noise * e)
        for a, e in zip(rz, squares, strict=True)
    ]
    dr.eval(inverse, enough, x, p, r, rz)  # else they would hold the images
    return inverse, enough, (x, p, r, rz)


@record
def _step(
    shape: list,
    state: State,
    curvature: Float | None,
    enough: list,
    inverse: Unknowns,
    lists: TileLists,
    cutoff: float,
) -> State:
    """Take a step of conjugate gradients.

    r follows ``r - alpha A^T q``, so that no image but q is needed.
    """
    x, p, r, rz = state
    Float, grid, channels = type(shape[0]), lists.grid, len(rz)
    packed = pack_parameters([*shape, *p[0]])
    x, q, alpha = _advance(packed, x, p, rz, curvature, lists, cutoff)
    change = apply_transposed(packed, q, channels, lists, cutoff)
    r = add_multiple(r, [-a for a in alpha], change, lists.image)
    z = multiply(r, inverse)
    new_rz = dots(r, z, grid)
    goes_on = [a > least for a, least in zip(new_rz, enough, strict=True)]
    beta = [
        dr.select(go & (a > 0), b / a, Float(0))
        for go, a, b in zip(goes_on, rz, new_rz, strict=True)
    ]
    factor = [dr.select(go, Float(1), 0) for go in goes_on]
    dr.eval(beta, factor)
    nothing = ([0.0] * channels,) * 2
    p = add_multiple(add_multiple(nothing, factor, z, lists.image), beta, p, lists.image)
    dr.eval(x, p, r, new_rz)  # else they would hold the image q
    return x, p, r, new_rz


def take_step(
    shape: list,
    x: Unknowns,
    error: Float,
    curvature: Float | None,
    inverse: Unknowns,
    lists: TileLists,
    cutoff: float,
) -> Unknowns:
    """Take one step of steepest descent from the unknowns x.

    Cost: an adjoint with respect to colours and a rendering.

    Parameters
    ----------
    shape : list of Float, shape (N,)
        See `detached_shape`.
    x : Unknowns
    error : Float
        ``H (A x - D)`` in tile layout, evaluated. It becomes that of the result, in place.
    curvature : Float or None
        The diagonal H, see `eigengs_dr.fitting.objective.Quadratic`.
    inverse : Unknowns
        The preconditioner: one over the diagonal. Unknowns where it is 0 keep their values.
    lists : TileLists
    cutoff : float
    """
    packed = pack_parameters([*shape, *x[0]])
    r = negate(apply_transposed(packed, error, len(inverse[0]), lists, cutoff))
    p = multiply(r, inverse)
    rz = dots(r, p, lists.grid)
    packed = pack_parameters([*shape, *p[0]])
    x, q, alpha = _advance(packed, x, p, rz, curvature, lists, cutoff)
    _add_in_place(error, q, alpha, lists)
    return x


def _advance(
    packed: Float,
    x: Unknowns,
    p: Unknowns,
    rz: list,
    curvature: Float | None,
    lists: TileLists,
    cutoff: float,
) -> tuple[Unknowns, Float, list]:
    """Move x along p to the least error; `packed` has the colours of p.

    Return x, ``q = H A p``, and ``alpha = rz / <A p, q>``.
    """
    image = image_of(packed, p[1], lists, kernel_radius(cutoff))
    q, lengths = difference(image, lists, None, curvature)
    # A channel that is solved except for rounding stops: its directions would grow without bound.
    alpha = [dr.select(k > 0, a / k, 0) for a, k in zip(rz, lengths, strict=True)]
    dr.eval(alpha)
    return add_multiple(x, alpha, p, lists.image), q, alpha


def _add_in_place(image: Float, step: Float, factors: list, lists: TileLists) -> None:
    """Add ``factor step`` by channels to an image in tile layout, in the memory of the image.

    A frozen program would copy the image, because it may not change its arguments. No two lanes
    write the same pixel, so that no atomic operations are needed.
    """
    types, grid = types_of(image), lists.grid
    tile, length = dr.arange(types.UInt, grid.tiles), grid.pixels * len(factors)
    change = gather_run(types, step, tile, length, True)
    owner = lists.layout.image_of(tile)
    factors = [spread(f, owner) for f in factors]
    added = [c * f for c, f in zip(change, factors * grid.pixels, strict=True)]
    add, alone = dr.ReduceOp.Add, dr.ReduceMode.NoConflicts
    dr.scatter_reduce(add, image, types.FloatX(added), tile, mode=alone)
    dr.eval(image)


def apply(
    packed: Float, background: list, lists: TileLists, cutoff: float, model: Quadratic
) -> tuple[Float, list]:
    """Return ``H (A x - D)``, and the sums of ``h (A x - D)^2`` of every channel and image."""
    image = image_of(packed, background, lists, kernel_radius(cutoff))
    return difference(image, lists, model.target, model.curvature)


def apply_transposed(
    packed: Float, delta: Float, channels: int, lists: TileLists, cutoff: float
) -> Unknowns:
    """Return ``A^T d``: correlations with every Gaussian, and the sum of every channel."""
    color = correlate(packed, delta, channels, lists, cutoff)
    return color, channel_sums(delta, channels, lists.grid)


def correlate(
    packed: Float,
    delta: Float,
    channels: int,
    lists: TileLists,
    cutoff: float,
    factors: Float | None = None,
) -> list:
    """Return for each channel the correlations of an image with every Gaussian.

    After them come the products of the squared weights with one or more images of factors. The
    colours in `packed` do not matter, but their number.
    """
    return adjoint(packed, delta, channels, lists, kernel_radius(cutoff), True, factors)


def weigh(
    packed: Float, delta: Float, channels: int, lists: TileLists, cutoff: float, factors: Float
) -> tuple[list, Unknowns]:
    """Return the correlations of an image d with every Gaussian, and the diagonal of ``A^T F A``.

    F holds factors of the squares of errors, one for all channels or one for each. Cost: one pass
    over the lists.
    """
    products = correlate(packed, delta, channels, lists, cutoff, factors)
    diagonal = products[channels:]
    return products[:channels], (diagonal, channel_sums(factors, len(diagonal), lists.grid))


def for_channels(values: list, channels: int) -> list:
    """Return a value for each channel, from one for all or one for each."""
    return values * (channels // len(values))


def preconditioner(diagonal: Unknowns, channels: int) -> Unknowns:
    """Return one over a diagonal for each channel, and 0 for a Gaussian without a pixel."""
    inverse = ([dr.select(d > 1e-8, rcp(d), 0) for d in part] for part in diagonal)
    color, background = (for_channels(part, channels) for part in inverse)
    return color, background


def held_background(inverse: Unknowns) -> Unknowns:
    """Return a preconditioner with which the background keeps its value."""
    Float = type(inverse[1][0])
    return inverse[0], [dr.opaque(Float, 0)] * len(inverse[1])


def negate(x: Unknowns) -> Unknowns:
    """Return ``-x``."""
    return [-v for v in x[0]], [-v for v in x[1]]


def multiply(x: Unknowns, y: Unknowns) -> Unknowns:
    """Return the products of all entries."""
    color, background = (
        [a * b for a, b in zip(u, v, strict=True)] for u, v in zip(x, y, strict=True)
    )
    return color, background


def dots(x: Unknowns, y: Unknowns, grid: Grid) -> list:
    """Return the inner products for each channel, Floats of shape (images,)."""
    color, background = multiply(x, y)
    dr.eval(color)
    return [sum_by_image(c, grid) + b for c, b in zip(color, background, strict=True)]


def add_multiple(x: Unknowns, factors: list, y: Unknowns, image: UInt | None) -> Unknowns:
    """Return ``x + factor y``; a factor has one value for each image."""
    color = [dr.fma(spread(f, image), b, a) for a, f, b in zip(x[0], factors, y[0], strict=True)]
    return color, [dr.fma(f, b, a) for a, f, b in zip(x[1], factors, y[1], strict=True)]

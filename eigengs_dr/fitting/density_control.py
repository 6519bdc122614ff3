"""Density control: drop the Gaussians of least use, and add Gaussians where the error is large."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import Bool, Float, UInt, make_divisor, types_of
from ..backend.recording import record
from ..gaussian.gaussians import Gaussians, concatenate, take
from ..raster.binning.lists import TileLists
from ..raster.binning.tiles import Grid
from ..raster.kernels import channel_moments
from ..raster.parameters import detached_shape
from ..raster.render import batch_to_tiles, bin_gaussians, pixels_inside, to_tiles
from .descent import TiledImage
from .placement.adaptive import redistribute
from .placement.filters import Canvas
from .placement.peaks import SIZE, Peaks, residual_peaks
from .placement.pieces import order_along_hilbert
from .schedule import Relocation
from .solvers.conjugate_gradient import (
    Unknowns,
    apply,
    held_background,
    invert,
    solve,
    take_step,
    weigh,
)

Array = NDArray[np.floating]


class Part(NamedTuple):
    """A part of a picture, and of its Gaussians.

    Attributes
    ----------
    own : slice
        The Gaussians that may move.
    core : (slice, slice)
        The rows and columns to which they may move.
    """

    own: slice
    core: tuple[slice, slice]


@dataclass(frozen=True)
class DensityControl:
    """The density control of one image; see `eigengs_dr.fitting.descent.Control`.

    Attributes
    ----------
    target : ndarray of float32, shape (H, W, C)
        The image in the space of the set.
    weight : ndarray of float32, shape (H, W, C), or None
        Factor of the errors before squaring.
    shown : ndarray of float32, shape (H, W, C)
        The image that places Gaussians.
    solve_steps : int
        Steps of the colour solve after a placement.
    redistributes : bool
        Whether the descent may place all Gaussians anew: not where the start is a choice.
    """

    target: NDArray[np.float32]
    weight: NDArray[np.float32] | None
    shown: NDArray[np.float32]
    solve_steps: int = 10
    redistributes: bool = True

    def redistribute(self, gaussians: Gaussians, count: int) -> Gaussians:
        """Place `count` Gaussians anew, see `redistribute`."""
        return redistribute(
            gaussians, count, self.shown, self.target, self.weight, self.solve_steps
        )

    def relocate(self, gaussians: Gaussians, how: Relocation, image: TiledImage) -> Gaussians:
        """Move Gaussians, see the function `relocate`; neighbours in space stay so in memory.

        With 5,000 Gaussians on 256x256 pixels, the steps after 14 rounds else take 8 % longer.
        """
        found, images = relocate(gaussians, how, image), dr.width(gaussians.background[0])
        grid = Grid(found.width, found.height, images=images)
        canvas = Canvas.of(types_of(found.mean), grid)
        return take(found, order_along_hilbert(canvas, (found.mean[0], found.mean[1])))


@dataclass(frozen=True)
class PartControl(DensityControl):
    """The density control of a part of a picture.

    Attributes
    ----------
    part : Part
        The Gaussians that may move, and where.
    """

    part: Part | None = None

    def relocate(self, gaussians: Gaussians, how: Relocation, image: TiledImage) -> Gaussians:
        """Move Gaussians of the part; see the function `relocate`."""
        return relocate(gaussians, how, image, self.part)


@dataclass(frozen=True)
class LevelControl(DensityControl):
    """The density control of nested sets.

    Attributes
    ----------
    counts : tuple of int
        Numbers of Gaussians up to each level.
    """

    counts: tuple[int, ...] = ()

    def relocate(self, gaussians: Gaussians, how: Relocation, image: TiledImage) -> Gaussians:
        """Move the Gaussians of each level; see `relocate_levels`."""
        return relocate_levels(gaussians, how, self.counts, image)


ROUND = 1 / SIZE, 0.0, 1 / SIZE
"""The factor of an added Gaussian."""

PRUNE_STEPS = 5
"""Steps of the colour solve in `prune`, after which there may be no descent."""


def removal_cost(
    gaussians: Gaussians,
    target: NDArray[np.float32],
    weight: Array | None = None,
) -> NDArray[np.float32]:
    """Return how much the squared error grows if one Gaussian is removed, for each Gaussian.

    With the error e of the set, ``|e - c_n w_n|^2 - |e|^2 = c_n^2 <w_n, w_n> - 2 c_n <w_n, e>``,
    summed over channels. Cost: a rendering and an adjoint with respect to colours.

    Parameters
    ----------
    gaussians : Gaussians
    target : ndarray of float32, shape (H, W, C)
        The image in the space of the set.
    weight : ndarray, shape (H, W, C), optional
        Factor of the errors before squaring.

    Returns
    -------
    ndarray of float32, shape (N,)
        Negative if the set would be better without the Gaussian.
    """
    with dr.suspend_grad():
        scene = _compare(gaussians, _upload(gaussians, target, weight))
        error, _ = scene.error_of(scene.colors)
        return scene.weigh(error)[0].numpy()


@dataclass(frozen=True)
class _Comparison:
    """A set and its image on the device, with one build of tile lists.

    Attributes
    ----------
    shape : list of Float, shape (N,)
        See `detached_shape`.
    colors : Unknowns
    lists : TileLists
    cutoff : float
    target : Float
        The image in tile layout.
    squares : Float or None
        Squares of the weights in tile layout.
    """

    shape: list
    colors: Unknowns
    lists: TileLists
    cutoff: float
    target: Float
    squares: Float | None

    def error_of(self, colors: Unknowns) -> tuple[Float, list]:
        """Return the rendering with some colours minus the image, and its squares by lanes."""
        return apply(self.shape, colors, self.lists, self.cutoff, self.target)

    def weigh(self, error: Float) -> tuple[Float, Unknowns]:
        """Return the removal costs of a set with a known error, see `removal_cost`.

        Return ``<w_n, w_n>`` too, of each channel, or of all channels where there is no weight.
        """
        color, channels, factors = self.colors[0], len(self.colors[0]), self.squares
        if factors is None:
            factors = pixels_inside(types_of(self.target), self.lists.grid)
        weighted = error if self.squares is None else error * self.squares
        dr.eval(factors, weighted)
        along, diagonal = weigh(self.shape, weighted, channels, self.lists, self.cutoff, factors)
        own = diagonal[0] * (channels // len(diagonal[0]))
        cost = sum(c * (c * o - 2 * a) for c, o, a in zip(color, own, along, strict=True))
        return cost, diagonal

    def peaks(self, error: Float, count: int) -> Peaks:
        """Return where at most `count` added Gaussians would reduce an error of an image most."""
        canvas = Canvas(types_of(error), self.lists.grid, self.lists.sizes)
        return residual_peaks(canvas, -error, count, self.squares)


def _upload(gaussians: Gaussians, target: NDArray[np.float32], weight: Array | None) -> TiledImage:
    """Copy an image and its weights to the device."""
    types = types_of(gaussians.mean)
    weights = None if weight is None else batch_to_tiles(types, weight)
    return TiledImage(batch_to_tiles(types, target), weights)


def _compare(gaussians: Gaussians, image: TiledImage) -> _Comparison:
    """Compare a set with an image; list the Gaussians of the tiles if nobody has."""
    types, target, lists = types_of(gaussians.mean), image.values, image.lists
    if lists is None:
        lists = bin_gaussians(gaussians, images=dr.width(gaussians.background[0]))
    shape, zeros = detached_shape(gaussians), dr.zeros(types.Float, len(gaussians))
    colors = [c + zeros for c in gaussians.color], list(gaussians.background)
    squares = None if image.weight is None else dr.square(image.weight)
    dr.eval(shape, colors, squares)
    return _Comparison(shape, colors, lists, gaussians.cutoff, target, squares)


def prune(
    gaussians: Gaussians,
    target: NDArray[np.float32],
    count: int,
    weight: Array | None = None,
) -> Gaussians:
    """Keep the `count` Gaussians of largest removal cost, in order, and solve for the colours.

    For the other parameters see `removal_cost`. With a weight the colours stay, because the solve
    minimises the error without weights. A set with `count` or fewer Gaussians stays as it is.
    """
    if count >= len(gaussians):
        return gaussians
    value = removal_cost(gaussians, target, weight)
    kept = np.sort(np.argsort(-value, kind="stable")[:count])
    if weight is not None:
        return gaussians[kept]
    return solve(gaussians[kept], target, PRUNE_STEPS, warm_start=True)


def densify(
    gaussians: Gaussians,
    target: NDArray[np.float32],
    count: int,
    weight: Array | None = None,
) -> Gaussians:
    """Add round Gaussians where they reduce the error most, until the set has `count`.

    For the other parameters see `removal_cost`. The result may have fewer Gaussians, if
    `residual_peaks` finds too few places. A set with `count` or more Gaussians stays as it is.
    """
    if count <= len(gaussians):
        return gaussians
    with dr.suspend_grad():
        types = types_of(gaussians.mean)
        scene = _compare(gaussians, _upload(gaussians, target, weight))
        error, _ = scene.error_of(scene.colors)
        peaks = scene.peaks(error, count - len(gaussians))
        found = dr.width(peaks.rank)
        if not found:
            return gaussians
        added = replace(
            gaussians,
            mean=peaks.mean,
            factor=dr.opaque(types.Float3, ROUND, found),
            color=types.FloatX(peaks.color),
            background=0 * gaussians.background,
        )
        return concatenate([gaussians, added.bounded()])


def relocate(
    gaussians: Gaussians,
    how: Relocation,
    image: TiledImage,
    part: Part | None = None,
) -> Gaussians:
    """Move the Gaussians of least use to where they reduce the error most, and perturb all.

    The Gaussians of least `removal_cost` leave: they get the colour 0, and a step of the colour
    solve adapts the others. A second step gains 0.01 dB, and no step costs 0.02 to 0.2 dB (ten
    training photos of 256x256 pixels, 832 to 10,000 Gaussians, 300 to 3,000 steps). Round Gaussians
    at the peaks of the error that is left then take their places in the order, except the places of
    those that are dropped. All of it runs on the device.

    Parameters
    ----------
    gaussians : Gaussians
        Of a batch, the Gaussians of all images, image after image; each image is for itself.
    how : Relocation
    image : TiledImage
    part : Part, optional
        The Gaussians of one image that may move, and where. The background then stays.

    Returns
    -------
    Gaussians
        A set with as many Gaussians, less those dropped. Where `residual_peaks` finds too few
        places, Gaussians of least use stay, with the colour 0.
    """
    with dr.suspend_grad():
        scene, types = _compare(gaussians, image), types_of(gaussians.mean)
        grid, total = scene.lists.grid, len(gaussians)
        count = total // grid.images
        own = range(count) if part is None else range(count)[part.own]
        leaving, inside = max(int(how.share * len(own)), how.dropped), None
        if part is not None:
            core = np.zeros((grid.height, grid.width, gaussians.channels), np.float32)
            core[part.core] = 1
            inside = to_tiles(types, core, grid)
        cost, diagonal, strength = _weigh(scene, inside, own)
        keep, moved = dr.full(types.Float, 1, total), None
        if leaving:
            moved = _least(cost, leaving, grid.images)
            dr.scatter(keep, types.Float(0), moved)
        dr.eval(keep)
        colors, error = _without_some(scene, keep, diagonal, inside)

        # What takes their places
        peaks = scene.peaks(error, leaving - how.dropped)
        mean, factor = (
            type(rows)([row + dr.zeros(types.Float, total) for row in rows])
            for rows in (gaussians.mean, gaussians.factor)
        )
        if dr.width(peaks.rank):
            slot = peaks.image * dr.opaque(types.UInt, leaving) + peaks.rank
            slot = dr.gather(types.UInt, moved, slot)
            dr.scatter(mean, peaks.mean, slot)
            dr.scatter(factor, types.Float3(ROUND), slot)
            for row, new in zip(colors[0], peaks.color, strict=True):
                dr.scatter(row, new, slot)
        if how.noise:
            mean, factor = perturb(mean, factor, colors[0], own, strength, how)
        found = replace(
            gaussians,
            mean=mean,
            factor=factor,
            color=types.FloatX(colors[0]),
            background=types.FloatX(colors[1]),
        )
        return _without(found, moved, how.dropped, grid.images).bounded()


@record
def _weigh(scene: _Comparison, inside: Float | None, own: range) -> tuple[Float, Unknowns, Float]:
    """Return the removal costs, infinite for others than the own Gaussians.

    Parameters
    ----------
    scene : _Comparison
    inside : Float, or None
        Factor of the errors that count, where not all do.
    own : range
        The Gaussians of each image that may leave.

    Returns
    -------
    cost : Float, shape (N,)
    diagonal : Unknowns
        From `_Comparison.weigh`.
    strength : Float, shape (images,)
        Squared error of the image divided by the number of own Gaussians.
    """
    types, channels = types_of(scene.target), len(scene.colors[0])
    error, _ = scene.error_of(scene.colors)
    cost, diagonal = scene.weigh(error)
    if inside is not None:
        cost = dr.select(_among(dr.arange(types.UInt, dr.width(cost)), own), cost, dr.inf)
        error *= inside
    _, squares = channel_moments(error, channels, scene.lists.grid)
    return cost, diagonal, sum(squares) * dr.opaque(types.Float, 1 / max(1, len(own)))


@record
def _without_some(
    scene: _Comparison, keep: Float, diagonal: Unknowns, inside: Float | None
) -> tuple[Unknowns, Float]:
    """Set the colours of some Gaussians to 0, and adapt those of the others.

    Parameters
    ----------
    scene : _Comparison
    keep : Float, shape (N,)
        0 for the Gaussians without a colour, and 1 for the others.
    diagonal : Unknowns
        From `_Comparison.weigh`.
    inside : Float, or None
        Factor of the errors that count, where not all do. The background then stays.

    Returns
    -------
    colors : Unknowns
    error : Float
        The rendering minus the image, times `inside`.
    """
    channels = len(scene.colors[0])
    colors = [c * keep for c in scene.colors[0]], scene.colors[1]
    dr.eval(colors)
    error, _ = scene.error_of(colors)
    dr.eval(error)
    if scene.squares is None:
        inverse = [i * keep for i in invert(diagonal[0])] * channels
        free = inverse, invert(diagonal[1]) * channels
        free = free if inside is None else held_background(free)
        dr.eval(free)
        colors = take_step(scene.shape, colors, error, free, scene.lists, scene.cutoff)
        dr.eval(colors)
    return colors, error if inside is None else error * inside


def _among(number: UInt, own: range) -> Bool:
    """Return which numbers are in a range."""
    UInt = type(number)
    return (number >= dr.opaque(UInt, own.start)) & (number < dr.opaque(UInt, own.stop))


def _least(cost: Float, number: int, images: int) -> UInt:
    """Return the `number` Gaussians of least cost of each image, image after image."""
    types, total = types_of(cost), dr.width(cost)
    order = dr.argsort(cost)
    if images > 1:  # a stable sort by image keeps the order by cost
        image, _ = make_divisor(types, total // images).divmod(order)
        order = dr.gather(types.UInt, order, dr.argsort(image))
    image, rank = make_divisor(types, number).divmod(dr.arange(types.UInt, images * number))
    moved = dr.gather(types.UInt, order, image * dr.opaque(types.UInt, total // images) + rank)
    dr.eval(moved)
    return moved


def _without(gaussians: Gaussians, moved: UInt, dropped: int, images: int) -> Gaussians:
    """Drop the last `dropped` of the moved Gaussians of each image, from `_least`."""
    if not dropped:
        return gaussians
    types, leaving = types_of(gaussians.mean), dr.width(moved) // images
    image, rank = make_divisor(types, dropped).divmod(dr.arange(types.UInt, images * dropped))
    place = image * dr.opaque(types.UInt, leaving) + dr.opaque(types.UInt, leaving - dropped) + rank
    stays = dr.full(types.Bool, True, len(gaussians))
    dr.scatter(stays, types.Bool(False), dr.gather(types.UInt, moved, place))
    return take(gaussians, dr.compress(stays))


def relocate_levels(
    gaussians: Gaussians,
    how: Relocation,
    counts: Sequence[int],
    image: TiledImage,
) -> Gaussians:
    """Move the Gaussians of least use in each level to where the image up to it has most error.

    There is no perturbation: what the first level can bear costs the third one 0.5 to 0.9 dB.
    With 850, 1,190 and 1,530 Gaussians on 256x256 pixels of a training photo, these levels gain
    0.36, 0.62 and 0.75 dB in 1,000 steps. Solves for the colours of the first level, and a
    placement of it by its error, gain nothing more.

    Parameters
    ----------
    gaussians, image
        See `relocate`; the lists are made anew.
    how : Relocation
        Its share is that of the Gaussians of a level.
    counts : sequence of int
        Numbers of Gaussians up to each level, from `level_counts`.

    Returns
    -------
    Gaussians
        As many Gaussians in each level.
    """
    how = how._replace(noise=0.0)
    # Without a weight, `relocate` would solve for the colours of earlier levels too.
    values, weight, _ = image
    weight = dr.opaque(type(values), 1, dr.width(values)) if weight is None else weight
    everywhere = slice(None), slice(None)
    for before, count in pairwise([0, *counts]):
        part = Part(slice(before, count), everywhere)
        parts = [relocate(gaussians[:count], how, TiledImage(values, weight), part)]
        if count < len(gaussians):  # the background is one for all levels
            later = gaussians[count:]
            parts.append(replace(later, background=0 * later.background))
        gaussians = concatenate(parts)
    return gaussians


SHAPE_SHARE = 0.5
"""Noise of the logarithms of the sizes, relative to that of the mean in standard deviations."""

MAX_NOISE = 1.0
"""Largest noise of a mean, in standard deviations of its Gaussian."""


def perturb(
    mean: Float, factor: Float, color: list, own: range, error: Float, how: Relocation
) -> tuple[Float, Float]:
    """Add noise to the means and the factors of some Gaussians.

    A descent so leaves a poor local minimum. Kheradmand et al. ("3D Gaussian splatting as Markov
    chain Monte Carlo", NeurIPS 2024) add noise to means. Here shapes get noise too, and each
    Gaussian gets as much as the image can bear. A Gaussian with the factor F, the size s (the
    geometric mean of its standard deviations) and the amplitude ``A = color s`` adds the squared
    error ``pi/2 |A|^2 |F dm|^2`` if its mean moves by dm. So faint Gaussians move far, and those
    that carry the image stay near their places; the nearer a fit is to its image, the smaller are
    the moves.

    The noise is normal: ``F dm = e z`` for the mean, with two numbers z, and
    ``F' = [[exp(e u), e v], [0, exp(e w)]] F`` for the factor, with `SHAPE_SHARE` times such
    numbers u, v and w. Each mean alone adds about ``strength^2`` times the mean error:
    ``e = strength (error / (pi |A|^2))^(1/2)``, at most `MAX_NOISE`.

    Parameters
    ----------
    mean : Array2f, shape (N, 2)
    factor : Array3f, shape (N, 3)
    color : list of Float, shape (N,)
        By channels.
    own : range
        The Gaussians of one image that move; the images of a batch have equal noise.
    error : Float, shape (images,)
        Squared error of each image divided by the number of its Gaussians.
    how : Relocation
        Its noise is the strength. Equal seeds give equal noise.

    Returns
    -------
    mean : Array2f, shape (N, 2)
        Perturbed means may lie outside the image.
    factor : Array3f, shape (N, 3)
    """
    types, total = types_of(mean), dr.width(mean)
    count = total // dr.width(error)
    image, lane = make_divisor(types, count).divmod(dr.arange(types.UInt, total))
    error = dr.gather(types.Float, error, image)
    a, b, c = factor
    amplitude = sum(dr.square(row) for row in color) / (a * c)
    strength = dr.opaque(types.Float, how.noise)
    size = strength * dr.sqrt(error / (dr.pi * amplitude))
    # The comparison is false where the amplitude is 0.
    size = dr.select(size < MAX_NOISE, size, types.Float(MAX_NOISE))
    moves = _among(lane, own)
    size = dr.select(moves, size, 0)
    normal, first = dr.rng(how.seed).normal(types.Float, 5 * count), dr.opaque(types.UInt, count)
    x, y, u, v, w = (dr.gather(types.Float, normal, lane + k * first) * size for k in range(5))
    y /= c
    u, v, w = (SHAPE_SHARE * z for z in (u, v, w))
    wider = dr.exp(u)
    return (
        mean + dr.select(moves, types.Float2((x - b * y) / a, y), 0),
        dr.select(moves, types.Float3(wider * a, dr.fma(wider, b, v * c), dr.exp(w) * c), factor),
    )

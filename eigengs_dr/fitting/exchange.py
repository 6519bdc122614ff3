"""What controls, searches and levels do to Gaussians: remove, add and exchange them.

What a Gaussian is worth to an objective decides which leave and where others are added:
`removal_cost`, `prune`, `densify` and `exchange`. `eigengs_dr.fitting.control` says when.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import make_divisor, types_of
from ..backend.recording import record
from ..backend.types import Bool, Float, UInt
from ..gaussian.gaussians import Gaussians, broadcast_rows, concatenate, take
from ..raster.kernels import channel_sums
from ..raster.lists import TileLists
from ..raster.parameters import detached_shape, pack_parameters
from ..raster.render import bin_gaussians, to_tiles
from ..raster.tiles import Grid
from .objective import Part, Pixels, Quadratic
from .peaks import SIZE, Canvas, Peaks, residual_peaks
from .redistribution import Owners, error_by_pixel
from .solve import (
    Unknowns,
    apply,
    colors_of,
    for_channels,
    held_background,
    preconditioner,
    solve,
    take_step,
    weigh,
)

ROUND = 1 / SIZE, 0.0, 1 / SIZE
"""The factor of an added Gaussian."""

PRUNE_STEPS = 5
"""Steps of the colour solve in `prune`, which no descent may follow."""


@dataclass(frozen=True)
class _Comparison:
    """A set and a model on the device, with one build of tile lists.

    Attributes
    ----------
    shape : list of Float, shape (N,)
        See `detached_shape`.
    colors : Unknowns
    lists : TileLists
    cutoff : float
    model : Quadratic
    """

    shape: list
    colors: Unknowns
    lists: TileLists
    cutoff: float
    model: Quadratic

    def slope(self, colors: Unknowns) -> tuple[Float, list]:
        """Return ``h (p - t)`` for some colours, and the sums of ``h (p - t)^2`` by channels."""
        packed = pack_parameters([*self.shape, *colors[0]])
        return apply(packed, colors[1], self.lists, self.cutoff, self.model)

    def weigh(self, slope: Float) -> tuple[Float, Unknowns]:
        """Return the removal costs of a set with a known slope, see `removal_cost`.

        Also return ``<w_n, h w_n>`` for each channel, or for all channels if h has one value.
        """
        color, channels = self.colors[0], len(self.colors[0])
        factors = self.model.curvatures(self.lists.grid)
        dr.eval(factors, slope)
        packed = pack_parameters([*self.shape, *color])
        along, diagonal = weigh(packed, slope, channels, self.lists, self.cutoff, factors)
        squares = for_channels(diagonal[0], channels)
        cost = sum(c * (c * s - 2 * a) for c, s, a in zip(color, squares, along, strict=True))
        return cost, diagonal

    def peaks(self, slope: Float, count: int) -> Peaks:
        """Return where at most `count` added Gaussians would reduce the loss of an image most."""
        canvas = Canvas(types_of(slope), self.lists.grid, self.lists.layout)
        return residual_peaks(canvas, -slope, self.model.curvatures(self.lists.grid), count)


def _compare(gaussians: Gaussians, objective: Pixels, lists: TileLists | None) -> _Comparison:
    """Compare a set with an objective; list the Gaussians of the tiles unless lists are given."""
    if lists is None:
        lists = bin_gaussians(gaussians, images=objective.grid.images)
    shape, colors = detached_shape(gaussians), colors_of(gaussians)
    dr.eval(shape, colors)
    return _Comparison(shape, colors, lists, gaussians.cutoff, objective.model)


def removal_cost(gaussians: Gaussians, objective: Pixels) -> NDArray[np.float32]:
    """Return how much ``sum h (p - t)^2`` grows if one Gaussian is removed, for each Gaussian.

    With the error e of the set and its colour c, that is ``c_n^2 <w_n, h w_n> - 2 c_n <w_n, h e>``,
    summed over channels. Cost: a rendering and an adjoint with respect to colours.

    Parameters
    ----------
    gaussians : Gaussians
    objective : Pixels

    Returns
    -------
    ndarray of float32, shape (N,)
        Negative if the set would be better without the Gaussian.
    """
    with dr.suspend_grad():
        scene = _compare(gaussians, objective, None)
        slope, _ = scene.slope(scene.colors)
        cost: NDArray[np.float32] = scene.weigh(slope)[0].numpy()
        return cost


def prune(gaussians: Gaussians, objective: Pixels, count: int) -> Gaussians:
    """Keep the `count` Gaussians of largest removal cost, in order, and solve for the colours.

    A set with `count` or fewer Gaussians stays as it is.
    """
    if count >= len(gaussians):
        return gaussians
    cost = removal_cost(gaussians, objective)
    kept = np.sort(np.argsort(-cost, kind="stable")[:count])
    return solve(gaussians[kept], objective, PRUNE_STEPS, warm_start=True)


def densify(gaussians: Gaussians, objective: Pixels, count: int) -> Gaussians:
    """Add round Gaussians where they reduce the error most, until the set has `count`.

    The result may have fewer Gaussians, if `residual_peaks` finds too few places. A set with
    `count` or more Gaussians stays as it is.
    """
    if count <= len(gaussians):
        return gaussians
    with dr.suspend_grad():
        types = types_of(gaussians.mean)
        scene = _compare(gaussians, objective, None)
        slope, _ = scene.slope(scene.colors)
        peaks = scene.peaks(slope, count - len(gaussians))
        number = dr.width(peaks.rank)
        if not number:
            return gaussians
        added = replace(
            gaussians,
            mean=peaks.mean,
            factor=dr.opaque(types.Float3, ROUND, number),
            color=types.FloatX(peaks.color),
            background=0 * gaussians.background,
        )
        return concatenate([gaussians, added.bounded()])


MAX_ERROR = 0.6
"""Largest squared error of a Gaussian that stays over that of a placement."""


def merged(
    gaussians: Gaussians,
    placed: Gaussians,
    objective: Pixels,
    count: int,
    largest: float,
    solve_steps: int,
) -> tuple[Gaussians, int]:
    """Keep the Gaussians of a set where their error is small, and take those of another elsewhere.

    A Gaussian stays if the squared error of what it owns, see `Owners`, is at most `largest` times
    that of the other set. Where it is more, the Gaussians of the other set come.

    Parameters
    ----------
    gaussians, placed : Gaussians
        Sets of one image with the best colours for it.
    objective : Pixels
    count : int
        Number of Gaussians of the result.
    largest : float
    solve_steps : int
        Steps of the colour solves.

    Returns
    -------
    Gaussians
    kept : int
        How many of them are of the first set.
    """
    with dr.suspend_grad():
        before, after = (error_by_pixel(one, objective) for one in (gaussians, placed))
        after *= dr.opaque(type(after), largest)
        stays, comes = (
            np.less_equal(*(share.numpy() for share in Owners.of(one).collect(before, after)))
            for one in (gaussians, placed)
        )
        if not stays.any():
            return placed, 0
        if stays.all() and count == len(gaussians):
            return gaussians, count
        parts = [gaussians[stays]]
        if not comes.all():
            parts.append(replace(placed[~comes], background=0 * placed.background))
        both = solve(concatenate(parts), objective, solve_steps, warm_start=True)
        both = densify(prune(both, objective, count), objective, count)
        if len(both) < count:  # no place is left where another Gaussian would help
            return (gaussians, count) if len(gaussians) == count else (placed, 0)
        both = in_order(solve(both, objective, solve_steps, warm_start=True))
        places = [x + 1j * y for x, y in (one.mean.numpy() for one in (both, gaussians))]
        return both, int(np.isin(*places).sum())


def exchange(
    gaussians: Gaussians,
    objective: Pixels,
    share: float,
    dropped: int = 0,
    lists: TileLists | None = None,
) -> tuple[Gaussians, Float]:
    """Move the Gaussians of least use to where they reduce the error most.

    The Gaussians of least `removal_cost` leave: they get the colour 0, and a step of the colour
    solve adapts the others. A second step gains 0.01 dB, and no step costs 0.02 to 0.2 dB (ten
    training photos of 256x256 pixels, 832 to 10,000 Gaussians, 300 to 3,000 steps). Round Gaussians
    at the peaks of the error that is left then take their places in the order, except the places of
    those that are dropped. All of it runs on the device.

    Parameters
    ----------
    gaussians : Gaussians
        For a batch, the Gaussians of all images, image after image; each image is separate.
    objective : Pixels
        With a part, only its Gaussians move, to its pixels; the background stays.
    share : float
        Share of the Gaussians that leave their places, in [0, 1].
    dropped : int, optional
        How many Gaussians of an image are dropped, even if the share is smaller.
    lists : TileLists, optional
        Lists that are valid for the set.

    Returns
    -------
    Gaussians
        As many Gaussians, less those dropped; neighbours in space are neighbours in memory, unless
        there is a part. Where `residual_peaks` finds too few places, Gaussians of least use stay,
        with the colour 0.
    squares : Float, shape (images,)
        ``sum h (p - t)^2`` of the images before.
    """
    with dr.suspend_grad():
        scene, types = _compare(gaussians, objective, lists), types_of(gaussians.mean)
        grid, total, part = scene.lists.grid, len(gaussians), objective.part
        count = total // grid.images
        movable = range(count) if part is None else range(count)[part.movable]
        leaving, inside = max(int(share * len(movable)), dropped), None
        if part is not None:
            inside = _core(objective, part)
        cost, diagonal, squares = _value(scene, inside, movable)
        keep, moved = dr.full(types.Float, 1, total), None
        if leaving:
            moved = _least(cost, leaving, grid.images)
            dr.scatter(keep, types.Float(0), moved)
        dr.eval(keep)
        colors, slope = _without_some(scene, keep, diagonal, inside)

        # What takes their places
        peaks = scene.peaks(slope, leaving - dropped)
        pair = gaussians.mean, gaussians.factor
        mean, factor = (type(rows)(broadcast_rows(rows, gaussians)) for rows in pair)
        if dr.width(peaks.rank):
            slot = peaks.image * dr.opaque(types.UInt, leaving) + peaks.rank
            slot = dr.gather(types.UInt, moved, slot)
            dr.scatter(mean, peaks.mean, slot)
            dr.scatter(factor, types.Float3(ROUND), slot)
            for row, new in zip(colors[0], peaks.color, strict=True):
                dr.scatter(row, new, slot)
        changed = replace(
            gaussians,
            mean=mean,
            factor=factor,
            color=types.FloatX(colors[0]),
            background=types.FloatX(colors[1]),
        )
        changed = _without(changed, moved, dropped, grid.images).bounded()
    return changed if part is not None else in_order(changed, grid.images), squares


def in_order(gaussians: Gaussians, images: int = 1) -> Gaussians:
    """Order Gaussians along a Hilbert curve through the tiles, image after image.

    The order is that of `eigengs_dr.fitting.place.hilbert_curve`, from the bits of columns and
    rows, the highest first. With 5,000 Gaussians on 256x256 pixels, the steps after 14 rounds take
    8 % longer without it.
    """
    types, grid = types_of(gaussians.mean), Grid(gaussians.width, gaussians.height, images=images)
    limits = (dr.opaque(types.Int, side) for side in (grid.width - 1, grid.height - 1))
    x, y = (
        types.UInt(dr.clip(types.Int(v), 0, limit)) >> 2
        for v, limit in zip(gaussians.mean, limits, strict=True)
    )
    levels = (max(grid.nx, grid.ny) - 1).bit_length()

    def descend(level: UInt, x: UInt, y: UInt, key: UInt) -> tuple:
        level = level - 1
        right, low = (x >> level) & 1, (y >> level) & 1
        key = (key << 2) | (2 * right + (right ^ low))
        turn = dr.select(right == 1, types.UInt(0xFFFFFFFF), 0)  # counts from the other side
        return level, dr.select(low == 0, y ^ turn, x), dr.select(low == 0, x ^ turn, y), key

    image = types.UInt(0)
    if images > 1:
        divisor = make_divisor(types, len(gaussians) // images)
        image, _ = divisor.divmod(dr.arange(types.UInt, len(gaussians)))
    start = dr.opaque(types.UInt, levels), x, y, image
    *_, key = dr.while_loop(
        start, lambda level, *_: level > 0, descend, label="walk along the curve", max_iterations=-1
    )
    return take(gaussians, dr.argsort(key))


def _core(objective: Pixels, part: Part) -> Float:
    """Return 1 for the values of the pixels to which a part may move, and 0 for others."""
    width, height = objective.size
    core = np.zeros((height, width, objective.channels), np.float32)
    core[part.core] = 1
    return to_tiles(objective.types, core)


@record
def _value(
    scene: _Comparison, inside: Float | None, movable: range
) -> tuple[Float, Unknowns, Float]:
    """Return the removal costs, infinite for Gaussians that are not movable.

    Parameters
    ----------
    scene : _Comparison
    inside : Float, or None
        Factor of the errors that count, if not all do.
    movable : range
        The Gaussians of each image that may leave.

    Returns
    -------
    cost : Float, shape (N,)
    diagonal : Unknowns
        From `_Comparison.weigh`.
    squares : Float, shape (images,)
        ``sum h (p - t)^2`` of each image, where it counts.
    """
    types, channels = types_of(scene.model.target), len(scene.colors[0])
    slope, squares_of_channels = scene.slope(scene.colors)
    squares = sum(squares_of_channels)
    cost, diagonal = scene.weigh(slope)
    if inside is not None:
        cost = dr.select(among(dr.arange(types.UInt, dr.width(cost)), movable), cost, dr.inf)
        h = scene.model.curvatures_of_values(scene.lists.grid, channels)
        error = dr.select(h > 0, slope / h, 0)
        squares = sum(channel_sums(slope * error * inside, channels, scene.lists.grid))
    return cost, diagonal, squares


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
        Factor of the errors that count, if not all do. The background then stays.

    Returns
    -------
    colors : Unknowns
    slope : Float
        ``h (p - t)`` of the rendering, times `inside`.
    """
    channels = len(scene.colors[0])
    colors = [c * keep for c in scene.colors[0]], scene.colors[1]
    dr.eval(colors)
    slope, _ = scene.slope(colors)
    dr.eval(slope)
    inverse, background = preconditioner(diagonal, channels)
    free = [i * keep for i in inverse], background
    free = free if inside is None else held_background(free)
    dr.eval(free)
    curvature = scene.model.curvature
    colors = take_step(scene.shape, colors, slope, curvature, free, scene.lists, scene.cutoff)
    dr.eval(colors)
    return colors, slope if inside is None else slope * inside


def among(number: UInt, numbers: range) -> Bool:
    """Return which numbers are in a range."""
    UInt = type(number)
    return (number >= dr.opaque(UInt, numbers.start)) & (number < dr.opaque(UInt, numbers.stop))


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


def _without(gaussians: Gaussians, moved: UInt | None, dropped: int, images: int) -> Gaussians:
    """Drop the last `dropped` of the moved Gaussians of each image, from `_least`."""
    if not dropped:
        return gaussians
    assert moved is not None
    types, leaving = types_of(gaussians.mean), dr.width(moved) // images
    image, rank = make_divisor(types, dropped).divmod(dr.arange(types.UInt, images * dropped))
    place = image * dr.opaque(types.UInt, leaving) + dr.opaque(types.UInt, leaving - dropped) + rank
    stays = dr.full(types.Bool, True, len(gaussians))
    dr.scatter(stays, types.Bool(False), dr.gather(types.UInt, moved, place))
    return take(gaussians, dr.compress(stays))


def exchange_levels(gaussians: Gaussians, objective: Pixels, share: float) -> Gaussians:
    """Move the least useful Gaussians of each level to the largest errors of the image up to it.

    A step of the colour solve adapts the colours of a level and of those before it.

    With 850, 1,190 and 1,530 Gaussians on 256x256 pixels of a training photo, these levels gain
    0.36, 0.62 and 0.75 dB in 1,000 steps. Solves for the colours of the first level, and a
    placement of it by its error, gain nothing more.

    Parameters
    ----------
    gaussians : Gaussians
    objective : Pixels
        An objective with levels.
    share : float
        Share of the Gaussians of a level that leave their places.

    Returns
    -------
    Gaussians
        As many Gaussians in each level.
    """
    width, height = objective.size
    everywhere = slice(0, height), slice(0, width)
    for before, count in pairwise([0, *objective.levels, len(gaussians)]):
        part = Part(slice(before, count), everywhere)
        level = replace(objective, levels=(), part=part)
        parts = [exchange(gaussians[:count], level, share)[0]]
        if count < len(gaussians):  # the background is one for all levels
            later = gaussians[count:]
            parts.append(replace(later, background=0 * later.background))
        gaussians = concatenate(parts)
    return gaussians


def sort_levels(gaussians: Gaussians, objective: Pixels, counts: Sequence[int]) -> Gaussians:
    """Sort the Gaussians inside each level by their removal cost, the largest first."""
    order, before = [], 0
    for count in counts:
        value = removal_cost(gaussians[:count], objective)
        indices = np.arange(before, count)
        order.append(indices[np.argsort(-value[indices], kind="stable")])
        before = count
    return gaussians[np.concatenate(order)]

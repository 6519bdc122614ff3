"""Density control: drop the Gaussians of least use, and add Gaussians where the error is large."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import Float, types_of, upload
from ..gaussian.gaussians import Gaussians, concatenate, like
from ..raster.binning.lists import TileLists
from ..raster.parameters import detached_shape
from ..raster.render import bin_gaussians, pixels_inside, to_tiles
from .placement.adaptive import redistribute
from .placement.peaks import Peaks, residual_peaks
from .schedule import Relocation
from .solvers.conjugate_gradient import (
    Unknowns,
    apply,
    apply_squared,
    correlate,
    held_background,
    invert,
    reduce_error,
    solve,
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

    def relocate(self, gaussians: Gaussians, how: Relocation) -> Gaussians:
        """Move Gaussians; see the function `relocate`."""
        return relocate(gaussians, how, self.target, self.weight)


@dataclass(frozen=True)
class PartControl(DensityControl):
    """The density control of a part of a picture.

    Attributes
    ----------
    part : Part
        The Gaussians that may move, and where.
    """

    part: Part | None = None

    def relocate(self, gaussians: Gaussians, how: Relocation) -> Gaussians:
        """Move Gaussians of the part; see the function `relocate`."""
        return relocate(gaussians, how, self.target, self.weight, self.part)


@dataclass(frozen=True)
class LevelControl(DensityControl):
    """The density control of nested sets.

    Attributes
    ----------
    counts : tuple of int
        Numbers of Gaussians up to each level.
    """

    counts: tuple[int, ...] = ()

    def relocate(self, gaussians: Gaussians, how: Relocation) -> Gaussians:
        """Move the Gaussians of each level; see `relocate_levels`."""
        return relocate_levels(gaussians, how, self.counts, self.target, self.weight)


ROUND_STEPS = 2
"""Steps of the colour solve in a round of relocation, so that neighbours replace the Gaussians that
leave. The descent goes on: 5 steps have the PSNR of 2 (6 training photos, 600 to 5,000 Gaussians,
300 and 1,000 steps)."""

PRUNE_STEPS = 5
"""Steps of the colour solve in `prune`, after which there may be no descent."""


def removal_cost(
    gaussians: Gaussians,
    target: NDArray[np.float32],
    weight: Array | None = None,
) -> NDArray[np.float32]:
    """Return how much the squared error grows if one Gaussian is removed, for each Gaussian.

    With the error e of the set, ``|e - c_n w_n|^2 - |e|^2 = c_n^2 <w_n, w_n> - 2 c_n <w_n, e>``,
    summed over channels. Cost: a rendering and two adjoints with respect to colours.

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
        scene = _compare(gaussians, target, weight)
        error, _ = scene.error_of(scene.colors)
        return scene.removal_cost(error, scene.diagonal()).numpy()


class _Comparison(NamedTuple):
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
    squares: Float

    def error_of(self, colors: Unknowns) -> tuple[Float, list]:
        """Return the rendering with some colours minus the image, and its squares by lanes."""
        return apply(self.shape, colors, self.lists, self.cutoff, self.target)

    def diagonal(self) -> Unknowns:
        """Return ``<w_n, w_n>`` of each channel, or of all channels where there is no weight."""
        channels, factors = len(self.colors[0]), self.squares
        if factors is None:
            channels, factors = 1, pixels_inside(types_of(self.target), self.lists.grid)
        return apply_squared(self.shape, factors, channels, self.lists, self.cutoff)

    def removal_cost(self, error: Float, diagonal: Unknowns) -> Float:
        """Return the removal costs of a set with a known error; see `removal_cost`."""
        color, channels = self.colors[0], len(self.colors[0])
        weighted = error if self.squares is None else error * self.squares
        along = correlate(self.shape, weighted, channels, self.lists, self.cutoff)
        own = diagonal[0] * (channels // len(diagonal[0]))
        return sum(c * (c * o - 2 * a) for c, o, a in zip(color, own, along, strict=True))

    def peaks(self, error: Float, count: int) -> Peaks:
        """Return where added Gaussians would reduce an error most."""
        grid = self.lists.grid
        spacing = math.sqrt(grid.width * grid.height / dr.width(self.shape[0]))
        return residual_peaks(-error, grid, len(self.colors[0]), count, spacing, self.squares)


def _compare(
    gaussians: Gaussians, target: NDArray[np.float32], weight: Array | None
) -> _Comparison:
    """Upload an image, and list the Gaussians of its tiles."""
    types, lists = types_of(gaussians.mean), bin_gaussians(gaussians)
    shape, zeros = detached_shape(gaussians), dr.zeros(types.Float, len(gaussians))
    colors = [c + zeros for c in gaussians.color], list(gaussians.background)
    squares = None
    if weight is not None:
        squares = dr.square(to_tiles(types, np.asarray(weight, np.float32), lists.grid))
    image = to_tiles(types, target, lists.grid)
    dr.eval(shape, colors, squares)
    return _Comparison(shape, colors, lists, gaussians.cutoff, image, squares)


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
    return solve(gaussians[kept], target, PRUNE_STEPS, warm_start=True).gaussians


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
        scene = _compare(gaussians, target, weight)
        error, _ = scene.error_of(scene.colors)
        mean, size, color = scene.peaks(error, count - len(gaussians))
    if not len(mean):
        return gaussians
    return concatenate([gaussians, like(gaussians, mean, _round(size), color).bounded()])


def relocate(
    gaussians: Gaussians,
    how: Relocation,
    target: NDArray[np.float32],
    weight: Array | None = None,
    part: Part | None = None,
) -> Gaussians:
    """Move the Gaussians of least use to where they reduce the error most, and perturb all.

    Without them, the colours of the others are solved for, see `prune`; then round Gaussians at the
    peaks of the error take their places in the order, except those that are dropped. For the other
    parameters see `removal_cost`, for the perturbation see
    `eigengs_dr.fitting.density_control.perturb`.

    Parameters
    ----------
    how : Relocation
    part : Part, optional
        The Gaussians that may move, and where. The background then stays.

    Returns
    -------
    Gaussians
        A set with as many Gaussians, less those dropped. Where `residual_peaks` finds too few
        places, Gaussians of least use stay, with the colour 0.
    """
    own = np.arange(len(gaussians)) if part is None else np.arange(len(gaussians))[part.own]
    moved, colors, peaks, error = _take_out(gaussians, target, weight, part, own, how)
    mean, size, color = peaks
    new, at = gaussians.to_arrays() | colors, moved[: len(mean)]
    new["mean"][at], new["factor"][at], new["color"][at] = mean, _round(size), color
    if how.noise:
        perturb(new, own, error / len(own), how.noise, how.seed)
    for name in ("mean", "factor", "color"):
        new[name] = np.delete(new[name], moved[len(moved) - how.dropped :], axis=0)
    there = like(gaussians, **new).bounded()
    # The set may be of a class with other bounds.
    values = {name: getattr(there, name) for name in new}
    return replace(gaussians, **values).bounded()


def _take_out(
    gaussians: Gaussians,
    target: NDArray[np.float32],
    weight: Array | None,
    part: Part | None,
    own: NDArray[np.integer],
    how: Relocation,
) -> tuple[NDArray[np.integer], dict[str, Array], Peaks, float]:
    """Take the Gaussians of least use out of a set, and find where others would be of most use.

    The function solves for the colours of those that stay. One build of tile lists serves all: a
    Gaussian that is out has the colour 0, and keeps it.

    Returns
    -------
    moved : ndarray of int, shape (leaving,)
        The Gaussians of `own` that are out, those of least use first.
    colors : dict
        color (N, C) and background (C,).
    peaks : Peaks
        Of the error without them in the part, at most as many as are not dropped.
    error : float
        The squared error of the whole set in the part.
    """
    with dr.suspend_grad():
        scene, types = _compare(gaussians, target, weight), types_of(gaussians.mean)
        inside = types.Float(1)
        if part is not None:
            core = np.zeros_like(target)
            core[part.core] = 1
            inside = to_tiles(types, core, scene.lists.grid)
        error, _ = scene.error_of(scene.colors)
        diagonal = scene.diagonal()
        cost = scene.removal_cost(error, diagonal)
        before = dr.sum(dr.square(error * inside))
        dr.eval(cost, before)
        leaving = max(int(how.share * len(own)), how.dropped)
        moved = own[np.argsort(cost.numpy()[own], kind="stable")[:leaving]]
        stays = np.ones(len(gaussians), np.float32)
        stays[moved] = 0
        keep = upload(types.Float, stays)
        colors = [c * keep for c in scene.colors[0]], scene.colors[1]
        dr.eval(colors)
        error, _ = scene.error_of(colors)
        dr.eval(error)
        if weight is None:
            inverse = [i * keep for i in invert(diagonal[0])] * len(colors[0])
            free = inverse, invert(diagonal[1]) * len(colors[1])
            free = free if part is None else held_background(free)
            dr.eval(free)
            colors, _ = reduce_error(
                scene.shape, colors, error, free, scene.lists, scene.cutoff, ROUND_STEPS
            )
        peaks = scene.peaks(error * inside, leaving - how.dropped)
        rows = [np.stack([v.numpy() for v in found], axis=-1) for found in colors]
        return moved, {"color": rows[0], "background": rows[1][0]}, peaks, before[0]


def relocate_levels(
    gaussians: Gaussians,
    how: Relocation,
    counts: Sequence[int],
    target: NDArray[np.float32],
    weight: Array | None = None,
) -> Gaussians:
    """Move the Gaussians of least use in each level to where the image up to it has most error.

    There is no perturbation: what the first level can bear costs the third one 0.5 to 0.9 dB.
    With 850, 1,190 and 1,530 Gaussians on 256x256 pixels of a training photo, these levels gain
    0.36, 0.62 and 0.75 dB in 1,000 steps. Solves for the colours of the first level, and a
    placement of it by its error, gain nothing more.

    Parameters
    ----------
    gaussians, target, weight
        See `relocate`.
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
    weight = np.ones_like(target) if weight is None else weight
    everywhere = slice(None), slice(None)
    for before, count in pairwise([0, *counts]):
        part = Part(slice(before, count), everywhere)
        parts = [relocate(gaussians[:count], how, target, weight, part)]
        if count < len(gaussians):  # the background is one for all levels
            later = gaussians[count:]
            parts.append(replace(later, background=0 * later.background))
        gaussians = concatenate(parts)
    return gaussians


def _round(size: Array) -> Array:
    """Return the factors (n, 3) of round Gaussians with standard deviations (n,)."""
    return np.stack([1 / size, 0 * size, 1 / size], axis=1)


def _spacing(gaussians: Gaussians) -> float:
    return math.sqrt(gaussians.width * gaussians.height / len(gaussians))


SHAPE_SHARE = 0.5
"""Noise of the logarithms of the sizes, relative to that of the mean in standard deviations."""

MAX_NOISE = 1.0
"""Largest noise of a mean, in standard deviations of its Gaussian."""


def perturb(
    arrays: dict[str, Array], own: NDArray[np.integer], error: float, strength: float, seed: int
) -> None:
    """Add noise to the mean and the factor of some Gaussians, in place.

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
    arrays : dict of ndarray
        mean (N, 2), factor (N, 3) and color (N, C), see `eigengs_dr.Gaussians`. Perturbed Gaussians
        may leave the image.
    own : ndarray of int, shape (n,)
        The Gaussians that move.
    error : float
        Squared error of the image divided by the number of Gaussians.
    strength : float
    seed : int
        Equal seeds give equal noise.
    """
    mean, factor, color = (arrays[k][own].astype(np.float64) for k in ("mean", "factor", "color"))
    a, b, c = factor.T
    amplitude = np.square(color).sum(axis=1) / (a * c)
    most = np.pi * amplitude * MAX_NOISE**2 > strength**2 * error
    ratio = np.divide(error, np.pi * amplitude, where=most, out=np.zeros_like(amplitude))
    size = np.where(most, strength * np.sqrt(ratio), MAX_NOISE)
    normal = np.random.default_rng(seed).standard_normal((5, len(own))) * size
    x, y, (u, v, w) = normal[0], normal[1] / c, SHAPE_SHARE * normal[2:]
    arrays["mean"][own] = mean + np.stack([(x - b * y) / a, y], axis=1)
    wider = np.exp(u)
    arrays["factor"][own] = np.stack([wider * a, wider * b + v * c, np.exp(w) * c], axis=1)

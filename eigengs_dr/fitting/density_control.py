"""Density control: drop the Gaussians of least use, and add Gaussians where the error is large."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..gaussian.gaussians import Gaussians, concatenate, like
from ..image.resize import resample
from .placement.adaptive import redistribute, residual
from .placement.density import residual_peaks
from .schedule import Relocation
from .solvers.conjugate_gradient import inner_products, solve

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


WORKING_SPACING = 3.0
"""Pixels between Gaussians for `relocate`. Images with twice this spacing or more are shrunk first:
wide filters take long, and the descent moves Gaussians by a pixel at once."""

SOLVE_STEPS = 5
"""Steps of the colour solve after dropping Gaussians, so that their neighbours replace them."""


def removal_cost(
    gaussians: Gaussians,
    target: NDArray[np.float32],
    weight: Array | None = None,
) -> NDArray[np.float64]:
    """Return how much the squared error grows if one Gaussian is removed, for each Gaussian.

    With the residual r of the set, ``|r + c_n w_n|^2 - |r|^2 = c_n^2 <w_n, w_n> + 2 c_n <w_n, r>``,
    summed over channels. Cost: two adjoints with respect to colours.

    Parameters
    ----------
    gaussians : Gaussians
    target : ndarray of float32, shape (H, W, C)
        The image in the space of the set.
    weight : ndarray, shape (H, W, C), optional
        Factor of the errors before squaring.

    Returns
    -------
    ndarray of float64, shape (N,)
        Negative if the set would be better without the Gaussian.
    """
    return _removal_cost(gaussians, residual(gaussians, target), weight)


def _removal_cost(gaussians: Gaussians, missed: Array, weight: Array | None) -> NDArray[np.float64]:
    """Return the removal costs of a set with a known residual."""
    counts = np.ones_like(missed) if weight is None else np.square(weight).astype(np.float32)
    along = inner_products(gaussians, missed * counts)
    own = inner_products(gaussians, counts, squared=True)
    color = gaussians.to_arrays()["color"].astype(np.float64)
    cost: NDArray[np.float64] = (color * (color * own + 2 * along)).sum(axis=1)
    return cost


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
    return solve(gaussians[kept], target, SOLVE_STEPS, warm_start=True).gaussians


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
    missed = residual(gaussians, target)
    mean, size, color = residual_peaks(missed, count - len(gaussians), _spacing(gaussians), weight)
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
    index, arrays = np.arange(len(gaussians)), gaussians.to_arrays()
    own = index if part is None else index[part.own]
    value, error = _costs_and_error(gaussians, target, weight, part)
    leaving = max(int(how.share * len(own)), how.dropped)
    moved = own[np.argsort(value[own], kind="stable")[:leaving]]
    kept = np.setdiff1d(index, moved)
    stay = {k: v if k == "background" else v[kept] for k, v in arrays.items()}
    rest = like(gaussians, **stay).bounded()
    if weight is None:
        held = None if part is None else arrays["background"]
        rest = solve(rest, target, SOLVE_STEPS, warm_start=True, background=held).gaussians
    missed = residual(rest, target)
    if part is not None:
        inside = np.zeros_like(missed)
        inside[part.core] = missed[part.core]
        missed = inside
    places = leaving - how.dropped
    mean, size, color = _coarse_peaks(missed, places, _spacing(gaussians), weight)
    found = rest.to_arrays()
    rows = {"mean": mean, "factor": _round(size), "color": color}
    new = {"background": found["background"]}
    for name, peaks in rows.items():
        new[name] = np.array(arrays[name])
        new[name][kept], new[name][moved[: len(peaks)]] = found[name], peaks
    new["color"][moved[len(mean) :]] = 0
    if how.noise:
        perturb(new, own, error / len(own), how.noise, how.seed)
    for name in rows:
        new[name] = np.delete(new[name], moved[places:], axis=0)
    there = like(gaussians, **new).bounded()
    # The set may be of a class with other bounds.
    values = {name: getattr(there, name) for name in new}
    return replace(gaussians, **values).bounded()


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


def _coarse_peaks(
    missed: Array, count: int, spacing: float, weight: Array | None
) -> tuple[Array, Array, Array]:
    """Return the places of `residual_peaks`, on a smaller image where Gaussians are far apart."""
    times = int(spacing / WORKING_SPACING)
    if times < 2:
        return residual_peaks(missed, count, spacing, weight)
    height, width = missed.shape[:2]
    size = -(-width // times), -(-height // times)
    small = [None if v is None else resample(v, *size) for v in (missed, weight)]
    x, y = width / size[0], height / size[1]
    assert small[0] is not None
    mean, deviation, color = residual_peaks(small[0], count, spacing / math.sqrt(x * y), small[1])
    return mean * (x, y), deviation * math.sqrt(x * y), color


def _costs_and_error(
    gaussians: Gaussians, target: NDArray[np.float32], weight: Array | None, part: Part | None
) -> tuple[NDArray[np.float64], float]:
    """Return the removal costs and the squared error of a part, from one residual."""
    missed = residual(gaussians, target)
    inside = missed if part is None else missed[part.core]
    # einsum converts to double precision without a copy of the whole.
    error = float(np.einsum("ijk,ijk->", inside, inside, dtype=np.float64))
    return _removal_cost(gaussians, missed, weight), error


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

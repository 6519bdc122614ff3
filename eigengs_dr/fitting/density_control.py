"""Fewer splats where they are worth least, more where an image is missed most."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import types_of
from ..gaussian.gaussians import Gaussians, concatenate
from ..raster.render import CUTOFF
from .redistribute import residual
from .solvers.conjugate_gradient import correlations, solve

Array = NDArray[np.floating]

SIZES = (0.2, 0.35, 0.6, 1.0, 1.6)
"""Standard deviations of splats that are tried where one is added, in distances of splats."""

REACH = 3.0
"""Standard deviations within which residuals are blurred."""

APART = 1.5
"""How far, in its standard deviations, a splat that is added keeps others away."""

SOLVE_STEPS = 5
"""Steps of the colour solve after splats were dropped: their neighbours take over."""


def worth(
    gaussians: Gaussians,
    target: NDArray[np.float32],
    weight: Array | None = None,
    cutoff: float = CUTOFF,
) -> NDArray[np.float64]:
    """Rise of the squared error if a splat were gone and all others stayed as they are.

    With the residual r of the set, ``|r + c_n w_n|^2 - |r|^2 = c_n^2 <w_n, w_n> + 2 c_n <w_n, r>``,
    summed over channels. Cost: two adjoints with respect to colours.

    Parameters
    ----------
    gaussians : Gaussians
    target : ndarray of float32, shape (H, W, C)
        The image in the space of the set.
    weight : ndarray, shape (H, W, C), optional
        What errors are multiplied by before they are squared.
    cutoff : float, optional

    Returns
    -------
    ndarray, shape (N,)
        Negative where the set would be better without the splat.
    """
    counts = np.ones_like(target) if weight is None else np.square(weight).astype(np.float32)
    missed = residual(gaussians, target, cutoff) * counts
    along = correlations(gaussians, missed, cutoff)
    own = correlations(gaussians, counts, cutoff, squared=True)
    color = gaussians.to_arrays()["color"].astype(np.float64)
    return (color * (color * own + 2 * along)).sum(axis=1)


def pruned(
    gaussians: Gaussians,
    target: NDArray[np.float32],
    count: int,
    weight: Array | None = None,
    cutoff: float = CUTOFF,
) -> Gaussians:
    """Keep the `count` splats that are worth the most, in their order, and solve for the colours.

    Parameters are those of `worth`. With a weight colours stay: those that are solved for minimise
    the error without it.
    """
    value = worth(gaussians, target, weight, cutoff)
    kept = np.sort(np.argsort(-value, kind="stable")[:count])
    if weight is not None:
        return gaussians[kept]
    return solve(gaussians[kept], target, SOLVE_STEPS, cutoff, warm_start=True).gaussians


def grown(
    gaussians: Gaussians,
    target: NDArray[np.float32],
    count: int,
    weight: Array | None = None,
    cutoff: float = CUTOFF,
) -> Gaussians:
    """Add round splats where one takes most from the error, until there are `count`.

    Parameters are those of `worth`. Fewer are added where the image has no more places, see
    `places`; none to a set that has as many.
    """
    if count <= len(gaussians):
        return gaussians
    missed = residual(gaussians, target, cutoff)
    mean, size, color = places(missed, count - len(gaussians), _spacing(gaussians), weight)
    if not len(mean):
        return gaussians
    sharp = 1 / size
    added = Gaussians.from_arrays(
        mean,
        np.stack([sharp, 0 * sharp, sharp], axis=1),
        color,
        size=(gaussians.width, gaussians.height),
        space=gaussians.space,
        backend=types_of(gaussians.mean).backend,
    )
    return concatenate([gaussians, added.bounded()])


def places(
    missed: Array, count: int, spacing: float, weight: Array | None = None
) -> tuple[Array, Array, Array]:
    """Find where round splats would take most from a squared error.

    A splat ``w`` with the best colour ``<w, r> / <w, w>`` takes ``<w, r>^2 / <w, w>``. With b, the
    residual r blurred by its standard deviation s, ``<w, r> = S^2 b`` and ``<w, w> = T^2``, where
    ``S = sum_k exp(-k^2 / (2 s^2))`` and ``T = sum_k exp(-k^2 / s^2)`` over the pixels k away along
    an axis; for large s that is a colour of 2 b and a gain of ``4 pi s^2 b^2``. Maxima of the gain
    over places and `SIZES` are taken in turn, the largest first, none nearer to one already taken
    than `APART`.

    Parameters
    ----------
    missed : ndarray, shape (H, W, C)
        Residual r.
    count : int
        How many, at most.
    spacing : float
        Distance of splats in pixels.
    weight : ndarray, shape (H, W, C), optional
        What errors are multiplied by before they are squared.

    Returns
    -------
    mean : ndarray, shape (n, 2)
        n <= count.
    size : ndarray, shape (n,)
        Standard deviations in pixels.
    color : ndarray, shape (n, C)
    """
    from scipy.ndimage import maximum_filter

    gain, size, color = _best_sizes(missed, spacing, weight)
    row, column = np.nonzero((gain == maximum_filter(gain, 3)) & (gain > 0))
    order = np.argsort(-gain[row, column], kind="stable")
    free = np.ones(gain.shape, bool)
    chosen: list[tuple[int, int]] = []
    for y, x in zip(row[order], column[order], strict=True):
        if len(chosen) >= count:
            break
        if free[y, x]:
            chosen.append((y, x))
            reach = math.ceil(APART * size[y, x])
            free[max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1] = False
    y, x = np.array(chosen, np.int64).reshape(-1, 2).T
    return np.stack([x + 0.5, y + 0.5], axis=1), size[y, x], color[y, x]


def _best_sizes(missed: Array, spacing: float, weight: Array | None) -> tuple[Array, Array, Array]:
    """Gain, size and colour of the best of `SIZES` at every pixel."""
    from scipy.ndimage import gaussian_filter

    counts = 1.0 if weight is None else np.square(weight)
    gain = np.zeros(missed.shape[:2])
    size, color = np.full(gain.shape, spacing), np.zeros(missed.shape)
    for deviation in (s * spacing for s in SIZES):
        blur = gaussian_filter(missed, (deviation, deviation, 0), mode="constant", truncate=REACH)
        radius = int(REACH * deviation + 0.5)  # that of the filter
        away = np.arange(-radius, radius + 1)
        taps = np.exp(-0.5 * np.square(away / deviation))
        projected, own_square = taps.sum() ** 2, np.square(taps).sum() ** 2
        own = projected**2 / own_square * (np.square(blur) * counts).sum(axis=2)
        better = own > gain
        gain = np.where(better, own, gain)
        size = np.where(better, deviation, size)
        color = np.where(better[..., None], projected / own_square * blur, color)
    return gain, size, color


def _spacing(gaussians: Gaussians) -> float:
    return math.sqrt(gaussians.width * gaussians.height / len(gaussians))

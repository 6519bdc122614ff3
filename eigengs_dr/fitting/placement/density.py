"""Where Gaussians belong: the density that an error asks for, and the peaks of a residual."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .adaptive import nearest_center

Array = NDArray[np.floating]

ERROR_EXPONENT = 4 / 3
"""Twice as many splats leave ``2^-FALL`` of the squared error: 4 dB, as measured from 1,250 to
20,000 splats on 256x256 pixels."""


NEIGHBORS = 6
"""Neighbours over which errors and densities are averaged: those of one splat are chance."""


MIN_ERROR_SHARE = 1e-3
"""Share of the average error that every splat counts with: no part of an image is stripped bare."""


def target_density(mean: Array, error: Array, bending: Array) -> NDArray[np.float64]:
    """Density that leaves every splat the same error, up to a factor.

    Parameters
    ----------
    mean : ndarray, shape (N, 2)
        Where splats were, in pixels.
    error : ndarray, shape (H, W)
        Squared error that they left.
    bending : ndarray, shape (H, W)
        Density that the bending of the image asks for, up to a factor.

    Returns
    -------
    ndarray, shape (H, W)
        A splat's pixels, those that are nearest to it, get ``s^(1 / (FALL + 1))`` splats.
    """
    from scipy.spatial import cKDTree

    count = len(mean)
    owner = nearest_center(mean, error.shape)
    _, near = cKDTree(mean).query(mean, min(NEIGHBORS, count))
    near = near.reshape(count, -1)

    def around(values: Array) -> Array:
        return np.bincount(owner, values.ravel(), count)[near].mean(axis=1)

    share, mass = around(error), around(bending)
    share = np.maximum(share, MIN_ERROR_SHARE * share.mean()) ** (1 / (ERROR_EXPONENT + 1))
    if not share.any():  # nothing was missed
        share = np.ones(count)
    ratio = share / np.maximum(mass, 1e-9 * mass.mean())
    return bending.astype(np.float64) * ratio[owner].reshape(error.shape)


CANDIDATE_SIZES = (0.2, 0.35, 0.6, 1.0, 1.6)
"""Standard deviations of splats that are tried where one is added, in distances of splats."""


BLUR_TRUNCATION = 3.0
"""Standard deviations within which residuals are blurred."""


SUPPRESSION_RADIUS = 1.5
"""How far, in its standard deviations, a splat that is added keeps others away."""


def residual_peaks(
    missed: Array, count: int, spacing: float, weight: Array | None = None
) -> tuple[Array, Array, Array]:
    """Find where round splats would take most from a squared error.

    A splat ``w`` with the best colour ``<w, r> / <w, w>`` takes ``<w, r>^2 / <w, w>``. With b, the
    residual r blurred by its standard deviation s, ``<w, r> = S^2 b`` and ``<w, w> = T^2``, where
    ``S = sum_k exp(-k^2 / (2 s^2))`` and ``T = sum_k exp(-k^2 / s^2)`` over the pixels k away along
    an axis; for large s that is a colour of 2 b and a gain of ``4 pi s^2 b^2``. Maxima of the gain
    over places and `CANDIDATE_SIZES` are taken in turn, the largest first, none nearer to one
    already taken than `SUPPRESSION_RADIUS`.

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
            reach = math.ceil(SUPPRESSION_RADIUS * size[y, x])
            free[max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1] = False
    y, x = np.array(chosen, np.int64).reshape(-1, 2).T
    return np.stack([x + 0.5, y + 0.5], axis=1), size[y, x], color[y, x]


def _best_sizes(missed: Array, spacing: float, weight: Array | None) -> tuple[Array, Array, Array]:
    """Gain, size and colour of the best of `CANDIDATE_SIZES` at every pixel."""
    from scipy.ndimage import gaussian_filter

    counts = 1.0 if weight is None else np.square(weight)
    gain = np.zeros(missed.shape[:2])
    size, color = np.full(gain.shape, spacing), np.zeros(missed.shape)
    for deviation in (s * spacing for s in CANDIDATE_SIZES):
        blur = gaussian_filter(
            missed, (deviation, deviation, 0), mode="constant", truncate=BLUR_TRUNCATION
        )
        radius = int(BLUR_TRUNCATION * deviation + 0.5)  # that of the filter
        away = np.arange(-radius, radius + 1)
        taps = np.exp(-0.5 * np.square(away / deviation))
        projected, own_square = taps.sum() ** 2, np.square(taps).sum() ** 2
        own = projected**2 / own_square * (np.square(blur) * counts).sum(axis=2)
        better = own > gain
        gain = np.where(better, own, gain)
        size = np.where(better, deviation, size)
        color = np.where(better[..., None], projected / own_square * blur, color)
    return gain, size, color

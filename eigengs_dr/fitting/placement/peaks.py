"""The peaks of a residual: where added Gaussians would reduce the error most."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...image.metrics import blur, gaussian_taps
from ...image.strips import map_threads, strips, with_border

Array = NDArray[np.floating]
Indices = NDArray[np.intp]

CANDIDATE_SIZES = (0.2, 0.35, 0.6, 1.0, 1.6)
"""Candidate sizes of an added Gaussian, as multiples of the mean spacing."""


BLUR_TRUNCATION = 3.0
"""Radius of the blur of residuals, in standard deviations."""


SUPPRESSION_RADIUS = 1.5
"""Distance from an added Gaussian to the next one, in standard deviations of the added one."""


BATCH = 1 << 14
"""Number of maxima that are compared with each other at once; bounds the memory."""


class _Maxima(NamedTuple):
    """Local maxima of the gain.

    Attributes
    ----------
    row, column : ndarray of int, shape (n,)
    gain, size : ndarray of float32, shape (n,)
    color : ndarray of float32, shape (n, C)
    """

    row: Indices
    column: Indices
    gain: Array
    size: Array
    color: Array


def residual_peaks(
    missed: Array, count: int, spacing: float, weight: Array | None = None
) -> tuple[Array, Array, Array]:
    """Find where added round Gaussians would reduce the squared error most.

    A Gaussian with the weights w and the best colour ``<w, r> / <w, w>`` reduces the squared error
    by the gain ``<w, r>^2 / <w, w>``. With b, the residual r blurred by the standard deviation s of
    the Gaussian, ``<w, r> = S^2 b`` and ``<w, w> = T^2``, where ``S = sum_k exp(-k^2 / (2 s^2))``
    and ``T = sum_k exp(-k^2 / s^2)`` over the offsets k along an axis. For large s the colour is
    2 b and the gain ``4 pi s^2 b^2``. The function picks the maxima of the gain over positions and
    `CANDIDATE_SIZES`, the largest first, and skips positions inside the `SUPPRESSION_RADIUS` of
    earlier picks.

    Parameters
    ----------
    missed : ndarray, shape (H, W, C)
        Residual r.
    count : int
        Largest number of picks.
    spacing : float
        Mean distance between Gaussians in pixels.
    weight : ndarray, shape (H, W, C), optional
        Factor of the errors before squaring.

    Returns
    -------
    mean : ndarray, shape (n, 2)
        In pixels; n <= count.
    size : ndarray, shape (n,)
        Standard deviations in pixels.
    color : ndarray, shape (n, C)
        Best colours.
    """
    height, width = missed.shape[:2]
    parts = map_threads(
        lambda rows: _local_maxima(missed, spacing, weight, rows), strips(height, width)
    )
    row, column, gain, size, color = (np.concatenate(v) for v in zip(*parts, strict=True))
    order = np.argsort(-gain, kind="stable")
    row, column, size, color = row[order], column[order], size[order], color[order]
    reach = np.ceil(SUPPRESSION_RADIUS * size.astype(np.float64)).astype(np.intp)
    chosen = _keep_apart(row, column, reach, count, (height, width))
    mean = np.stack([column[chosen] + 0.5, row[chosen] + 0.5], axis=1)
    return mean, size[chosen].astype(np.float64), color[chosen]


def _local_maxima(missed: Array, spacing: float, weight: Array | None, rows: slice) -> _Maxima:
    """Return the maxima of the gain among 3x3 pixels, for some rows of an image."""
    height, width, channels = missed.shape

    def counts(part: slice) -> Array:
        assert weight is not None
        return np.square(np.moveaxis(weight[part], 2, 0), dtype=np.float32)

    squares = None if weight is None else with_border(counts, rows, height, 1, "constant")
    gain = np.zeros((rows.stop - rows.start + 2, width + 2), np.float32)
    size, color = np.full_like(gain, spacing), np.zeros((channels, *gain.shape), np.float32)
    for deviation in (s * spacing for s in CANDIDATE_SIZES):
        taps = gaussian_taps(deviation, BLUR_TRUNCATION)
        away = np.arange(1 - len(taps), len(taps))
        weights = np.exp(-0.5 * np.square(away / deviation))
        projected, own_square = weights.sum() ** 2, np.square(weights).sum() ** 2
        blurred = np.empty_like(color)
        for channel in range(channels):

            def plane(part: slice, channel: int = channel) -> Array:
                return missed[part, :, channel].astype(np.float32, order="C")

            blurred[channel] = blur(with_border(plane, rows, height, len(taps), "constant"), taps)
        own = np.square(blurred) if squares is None else np.square(blurred) * squares
        total = own.sum(axis=0) * np.float32(projected**2 / own_square)
        better = total > gain
        np.copyto(gain, total, where=better)
        np.copyto(size, np.float32(deviation), where=better)
        np.copyto(color, blurred * np.float32(projected / own_square), where=better)
    return _inside_maxima(gain, size, color, rows, height)


def _inside_maxima(gain: Array, size: Array, color: Array, rows: slice, height: int) -> _Maxima:
    """Return the maxima of rows that have one pixel more on every side."""
    gain[:, [0, -1]] = -1  # outside the image
    if rows.start == 0:
        gain[0] = -1
    if rows.stop == height:
        gain[-1] = -1
    across = np.maximum(np.maximum(gain[:, :-2], gain[:, 2:]), gain[:, 1:-1])
    largest = np.maximum(np.maximum(across[:-2], across[2:]), across[1:-1])
    inside = gain[1:-1, 1:-1]
    row, column = np.nonzero((inside == largest) & (inside > 0))
    at = row + 1, column + 1
    return _Maxima(row + rows.start, column, gain[at], size[at], color[:, at[0], at[1]].T)


def _keep_apart(
    row: Indices, column: Indices, reach: Indices, count: int, shape: tuple[int, int]
) -> Indices:
    """Return the indices of positions, best first, that no earlier position suppresses.

    A position suppresses those after it with a distance of at most its reach along both axes, if
    it is not suppressed itself. The result is that of one loop over all positions.
    """
    free = np.ones(shape, bool)
    chosen = [np.zeros(0, np.intp)]
    missing = count
    for first in range(0, len(row), BATCH):
        if missing <= 0:
            break
        batch = np.arange(first, min(first + BATCH, len(row)))
        batch = batch[free[row[batch], column[batch]]]
        batch = batch[_greedy(np.stack([row[batch], column[batch]], axis=1), reach[batch])]
        batch = batch[:missing]
        _occupy(free, row[batch], column[batch], reach[batch])
        chosen.append(batch)
        missing -= len(batch)
    return np.concatenate(chosen)


def _greedy(position: Indices, reach: Indices) -> Indices:
    """Return the indices of positions (n, 2), best first, that no earlier one suppresses.

    Each round chooses all positions that no better open position could suppress.
    """
    from scipy.spatial import cKDTree

    is_open, is_chosen = np.ones(len(position), bool), np.zeros(len(position), bool)
    if not len(position):
        return np.flatnonzero(is_chosen)
    pairs = cKDTree(position).query_pairs(reach.max(), p=np.inf, output_type="ndarray")
    better, other = pairs.T  # better < other
    near = np.abs(position[better] - position[other]).max(axis=1) <= reach[better]
    better, other = better[near], other[near]
    while is_open.any():
        top = is_open.copy()
        top[other] = False
        is_chosen |= top
        is_open &= ~top
        is_open[other[top[better]]] = False
        matters = is_open[better] & is_open[other]
        better, other = better[matters], other[matters]
    return np.flatnonzero(is_chosen)


def _occupy(free: NDArray[np.bool_], row: Indices, column: Indices, reach: Indices) -> None:
    """Mark the squares around positions as not free."""
    height, width = free.shape
    for radius in np.unique(reach):
        own = reach == radius
        away = np.arange(-radius, radius + 1)
        columns = np.clip(column[own][:, None] + away, 0, width - 1)
        for shift in away:
            free[np.clip(row[own] + shift, 0, height - 1)[:, None], columns] = False

"""Where a fit left error: the density of Gaussians for it, and its peaks.

At a peak of the residual, an added Gaussian would reduce the error most.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...image.metrics import blur, gaussian_taps
from ...image.strips import map_threads, strips, with_border

Array = NDArray[np.floating]

ERROR_EXPONENT = 4 / 3
"""Exponent q of the decay of the squared error: twice as many Gaussians leave ``2^-q`` of it, which
is 4 dB less, as measured from 1,250 to 20,000 Gaussians on 256x256 pixels."""


NEIGHBORS = 6
"""Number of neighbours over which errors and densities are averaged; those of one Gaussian vary by
chance."""


MIN_ERROR_SHARE = 1e-3
"""Smallest error of a Gaussian, relative to the average, so that no part of an image gets empty."""


NO_ERROR = 1e-12
"""Smallest squared error of a Gaussian: parts without any error keep some Gaussians too."""


QUERY = 1 << 16
"""Number of Gaussians whose neighbours are found at once; bounds the memory."""


def target_density(mean: Array, error: Array, bending: Array) -> NDArray[np.float32]:
    """Return the density at which all Gaussians would have the same error, up to a factor.

    Parameters
    ----------
    mean : ndarray, shape (N, 2)
        Means of the old set, in pixels.
    error : ndarray, shape (H, W)
        Squared error of the old set.
    bending : ndarray, shape (H, W)
        Density for the second derivatives of the image, up to a factor. The result overwrites an
        array of float32.

    Returns
    -------
    ndarray of float32, shape (H, W)
        The pixels nearest to an old Gaussian with the error s together get ``s^(1 / (q + 1))``
        Gaussians, with q = `ERROR_EXPONENT`.
    """
    owner = nearest_center(mean, error.shape)
    ratio = density_ratio(mean, owner, error, bending)
    density = bending.astype(np.float32, copy=False)
    scale_by_owner(density, owner, ratio / ratio.mean())
    return density


def density_ratio(
    mean: Array, owner: NDArray[np.int32], error: Array, bending: Array
) -> NDArray[np.float64]:
    """Return the ratio of the density for the error to that for the second derivatives.

    For the other parameters see `target_density`. Ratios of several parts of an image have one
    scale: together they give a density of the whole image.

    Parameters
    ----------
    owner : ndarray of int32, shape (H, W)
        The Gaussian nearest to each pixel, by `nearest_center`.

    Returns
    -------
    ndarray of float64, shape (N,)
        For the pixels of each old Gaussian.
    """
    share, mass = _average_neighbors(
        mean, np.stack(sum_by_center(owner, len(mean), [(error,), (bending,)]))
    )
    share = np.maximum(share, max(MIN_ERROR_SHARE * share.mean(), NO_ERROR))
    ratio = share ** (1 / (ERROR_EXPONENT + 1)) / np.maximum(mass, 1e-9 * mass.mean())
    return np.asarray(ratio, np.float64)


def scale_by_owner(density: NDArray[np.float32], owner: NDArray[np.int32], ratio: Array) -> None:
    """Multiply a density (H, W) in place by the ratio (N,) of the Gaussian that owns each pixel."""
    factor = ratio.astype(np.float32)

    def scale(rows: slice) -> None:
        density[rows] *= factor[owner[rows]]

    map_threads(scale, strips(*density.shape))


def _average_neighbors(mean: Array, values: Array) -> Array:
    """Average values (k, N) over each Gaussian and its neighbours, `NEIGHBORS` in all."""
    from scipy.spatial import cKDTree

    tree, number = cKDTree(mean), min(NEIGHBORS, len(mean))

    def average(first: int) -> Array:
        _, near = tree.query(mean[first : first + QUERY], number)
        near = near.reshape(-1, number)
        return np.stack([row[near].mean(axis=1) for row in values])

    return np.concatenate(map_threads(average, range(0, len(mean), QUERY)), axis=1)


BLOCK = 512
"""Side of the blocks that are searched one by one, in pixels."""

BORDER = 24
"""Pixels around a block whose centres are searched too, at first. Three to six times the distance
of neighbours at a usual density; blocks with a longer distance are searched again."""


def center_pixels(mean: Array, shape: tuple[int, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return column and row of the pixels of centres (N, 2), clipped to an image (H, W)."""
    column = np.clip(mean[:, 0].astype(np.intp), 0, shape[1] - 1)
    return column, np.clip(mean[:, 1].astype(np.intp), 0, shape[0] - 1)


def nearest_center(mean: Array, shape: tuple[int, ...]) -> NDArray[np.int32]:
    """Return the index of the centre nearest to each pixel.

    A centre counts as the middle of its pixel. If several centres lie in one pixel, only the last
    counts.

    Parameters
    ----------
    mean : ndarray, shape (N, 2)
        x, y in pixels; fewer than 2^31 centres.
    shape : (int, int)
        Height and width of the image.

    Returns
    -------
    ndarray of int32, shape (H, W)
    """
    height, width = shape
    column, row = center_pixels(mean, shape)
    centers = np.full(shape, -1, np.int32)
    centers[row, column] = np.arange(len(mean), dtype=np.int32)
    owner = np.empty(shape, np.int32)

    def search(block: tuple[slice, slice]) -> None:
        owner[block] = _nearest_in(centers, *block)

    map_threads(
        search,
        [
            (slice(y, min(y + BLOCK, height)), slice(x, min(x + BLOCK, width)))
            for y in range(0, height, BLOCK)
            for x in range(0, width, BLOCK)
        ],
    )
    return owner


def _nearest_in(centers: NDArray[np.int32], rows: slice, columns: slice) -> NDArray[np.int32]:
    """Return the centres nearest to the pixels of a block; -1 marks pixels without a centre."""
    from scipy.ndimage import distance_transform_edt

    height, width = centers.shape
    border = BORDER
    while True:
        top, left = max(0, rows.start - border), max(0, columns.start - border)
        around = centers[top : rows.stop + border, left : columns.stop + border]
        whole = around.shape == (height, width)
        block = (
            slice(rows.start - top, rows.stop - top),
            slice(columns.start - left, columns.stop - left),
        )
        empty = around < 0
        if whole or not empty.all():
            y, x = (
                index[block]
                for index in distance_transform_edt(
                    empty, return_distances=False, return_indices=True
                )
            )
            away = np.square(y - np.arange(block[0].start, block[0].stop, dtype=np.int32)[:, None])
            away += np.square(x - np.arange(block[1].start, block[1].stop, dtype=np.int32))
            # No centre outside is nearer than the border is wide.
            if whole or away.max() <= border * border:
                return np.asarray(around[y, x])
        border *= 2


def sum_by_center(
    owner: NDArray[np.int32], count: int, maps: Sequence[Sequence[Array]]
) -> list[NDArray[np.float64]]:
    """Sum products of maps over the pixels of each centre.

    Parameters
    ----------
    owner : ndarray of int32, shape (H, W)
        See `nearest_center`.
    count : int
        Number of centres N.
    maps : sequence of sequence of ndarray, shape (H, W), (H, 1) or (W,)
        The factors of each product.

    Returns
    -------
    list of ndarray of float64, shape (N,)
        One array for each product.
    """
    sums = [np.zeros(count) for _ in maps]
    factors = [[np.broadcast_to(factor, owner.shape) for factor in product] for product in maps]
    for rows in strips(*owner.shape):
        index = owner[rows].ravel().astype(np.intp)
        for total, product in zip(sums, factors, strict=True):
            values = np.array(product[0][rows], np.float64)
            for factor in product[1:]:
                values *= factor[rows]
            np.add.at(total, index, values.ravel())
    return sums


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

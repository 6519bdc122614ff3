"""Where a fit left error: the density of Gaussians for it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...image.strips import map_threads, strips

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

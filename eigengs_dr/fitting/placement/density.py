"""The density of Gaussians for the error of a fit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...image.strips import map_threads, strips
from .nearest import nearest_center, sum_by_center

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

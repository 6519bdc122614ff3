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
    share, mass = _average_neighbors(
        mean, np.stack(sum_by_center(owner, len(mean), [(error,), (bending,)]))
    )
    share = np.maximum(share, MIN_ERROR_SHARE * share.mean()) ** (1 / (ERROR_EXPONENT + 1))
    if not share.any():  # the old set has no error
        share = np.ones(len(mean))
    ratio = share / np.maximum(mass, 1e-9 * mass.mean())
    ratio = (ratio / ratio.mean()).astype(np.float32)
    density = bending.astype(np.float32, copy=False)

    def scale(rows: slice) -> None:
        density[rows] *= ratio[owner[rows]]

    map_threads(scale, strips(*density.shape))
    return density


def _average_neighbors(mean: Array, values: Array) -> Array:
    """Average values (k, N) over each Gaussian and its neighbours, `NEIGHBORS` in all."""
    from scipy.spatial import cKDTree

    tree, number = cKDTree(mean), min(NEIGHBORS, len(mean))

    def average(first: int) -> Array:
        _, near = tree.query(mean[first : first + QUERY], number)
        near = near.reshape(-1, number)
        return np.stack([row[near].mean(axis=1) for row in values])

    return np.concatenate(map_threads(average, range(0, len(mean), QUERY)), axis=1)

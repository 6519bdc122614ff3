"""Where splats start: `place_random`, on a `grid`, or `adaptive` to the image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...gaussian.covariance import factor_from_covariance


def place_random(
    image: NDArray[np.floating], count: int, generator: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Place splats uniformly, shaped as GaussianImage does: Cholesky factors uniform in [0, 1].

    The covariance is ``L L^T`` with ``L = [[l1 + 0.5, 0], [l2, l3 + 0.5]]`` pixels.

    Parameters
    ----------
    image : ndarray, shape (H, W, C)
        Only its size is used.
    count : int
        Number of splats.
    generator : numpy.random.Generator

    Returns
    -------
    mean : ndarray, shape (count, 2)
        In pixels.
    factor : ndarray, shape (count, 3)
        a, b, c in 1 / pixels; see `eigengs_dr.Gaussians`.
    """
    height, width = image.shape[:2]
    mean = generator.uniform(0, [width, height], (count, 2))
    l1, l2, l3 = (generator.uniform(0, 1, (count, 3)) + np.array([0.5, 0, 0.5])).T
    return mean, factor_from_covariance(l1 * l1, l1 * l2, l2 * l2 + l3 * l3)

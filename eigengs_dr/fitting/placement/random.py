"""Random placement, as in GaussianImage."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...gaussian.covariance import factor_from_covariance


def place_random(
    image: NDArray[np.floating], count: int, generator: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw means uniformly in the image, and shapes as GaussianImage does.

    The covariance is ``L L^T`` with ``L = [[l1 + 0.5, 0], [l2, l3 + 0.5]]`` pixels and l1, l2, l3
    uniform in [0, 1].

    Parameters
    ----------
    image : ndarray, shape (H, W, C)
        The function uses only its size.
    count : int
        Number of Gaussians.
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

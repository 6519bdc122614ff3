"""Round Gaussians on a hexagonal grid."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...gaussian.covariance import factor_from_covariance

DEVIATION = 0.65
"""Standard deviation of a Gaussian, relative to the square root of the area per Gaussian. A smaller
one leaves gaps; a larger one gains nothing, slows the colour solve and makes the colours grow."""


def place_grid(
    image: NDArray[np.floating], count: int, generator: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Place round Gaussians in rows; shift every second row by half a distance.

    For parameters and results see `place_random`; the generator
    is not used. The count may be any number: rows differ by at most one Gaussian.
    """
    height, width = image.shape[:2]
    spacing = math.sqrt(width * height / count)
    # In a hexagonal grid with one point per area s^2, rows are sqrt(3) / 2 of a distance apart.
    rows = min(count, max(1, round(height / spacing * math.sqrt(2 / math.sqrt(3)))))
    starts = np.arange(rows + 1) * count // rows
    row = np.repeat(np.arange(rows), np.diff(starts))
    number = np.diff(starts)[row]
    place = np.arange(count) - starts[row] + np.where(number > 1, 0.25 + 0.5 * (row % 2), 0.5)
    mean = np.stack([place * width / number, (row + 0.5) * height / rows], axis=-1)
    sharpness = 1 / (DEVIATION * spacing)
    return mean, np.tile([sharpness, 0, sharpness], (count, 1))


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

"""Round Gaussians on a hexagonal grid."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

DEVIATION = 0.65
"""Standard deviation of a Gaussian, relative to the square root of the area per Gaussian. A smaller
one leaves gaps; a larger one gains nothing, slows the colour solve and makes the colours grow."""


def place_grid(
    image: NDArray[np.floating], count: int, generator: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Place round Gaussians in rows; shift every second row by half a distance.

    For parameters and results see `eigengs_dr.fitting.placement.random.place_random`; the generator
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

"""Where splats start: `random`, on a `grid`, or `adaptive` to the image."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

GRID_SIZE = 0.65
"""Standard deviation of a splat on the grid over the root of the area it has for itself. Smaller
leaves gaps; larger gains nothing, and colours take longer to solve for and grow."""


def random(
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
    return mean, inverse_factor(l1 * l1, l1 * l2, l2 * l2 + l3 * l3)


def inverse_factor(
    xx: NDArray[np.floating], xy: NDArray[np.floating], yy: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Factor the inverse of covariances ``[[xx, xy], [xy, yy]]``: ``Sigma^-1 = F^T F``.

    Returns
    -------
    ndarray, shape (N, 3)
        a, b, c of ``F = [[a, b], [0, c]]``.
    """
    a = np.sqrt(yy / (xx * yy - xy * xy))
    return np.stack([a, -xy / yy * a, 1 / np.sqrt(yy)], axis=-1).astype(np.float64)


def grid(
    image: NDArray[np.floating], count: int, generator: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Place round splats in rows, each shifted against the last by half a distance: hexagons.

    Parameters and results as for `random`; only the size of the image is used. Any count: rows
    differ by one splat at most.
    """
    height, width = image.shape[:2]
    spacing = math.sqrt(width * height / count)
    # In a hexagonal lattice with one point an area s^2, rows are sqrt(3) / 2 of a distance apart.
    rows = min(count, max(1, round(height / spacing * math.sqrt(2 / math.sqrt(3)))))
    starts = np.arange(rows + 1) * count // rows
    row = np.repeat(np.arange(rows), np.diff(starts))
    number = np.diff(starts)[row]
    place = np.arange(count) - starts[row] + np.where(number > 1, 0.25 + 0.5 * (row % 2), 0.5)
    mean = np.stack([place * width / number, (row + 0.5) * height / rows], axis=-1)
    sharpness = 1 / (GRID_SIZE * spacing)
    return mean, np.tile([sharpness, 0, sharpness], (count, 1))

"""Placements: where Gaussians start without a given start, before their colours are known.

`Adaptive` follows the second derivatives of the image; `Grid` and `Random` use only its size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..gaussian.covariance import factor_from_covariance
from ..gaussian.gaussians import Gaussians
from .objective import Pixels
from .placement.adaptive import place_adaptive

Shapes = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Means (N, 2) in pixels, and factors (N, 3), see `eigengs_dr.Gaussians`."""


@runtime_checkable
class Placement(Protocol):
    """Makes the first set of Gaussians for an objective."""

    has_colors: bool
    """Whether its colours stay; otherwise they are 0, and a solve finds the best ones."""

    def __call__(self, objective: Pixels, count: int, cutoff: float, seed: int) -> Gaussians:
        """Return `count` Gaussians for each image of a batch, image after image."""


@dataclass(frozen=True)
class Adaptive:
    """More and smaller Gaussians where the image has large second derivatives.

    See `eigengs_dr.fitting.placement.adaptive`.
    """

    has_colors = False

    def __call__(self, objective: Pixels, count: int, cutoff: float, seed: int) -> Gaussians:
        """Place Gaussians; see `Placement`."""
        return place_adaptive(objective, count, cutoff, seed=seed)


@dataclass(frozen=True)
class Grid:
    """Round Gaussians in rows, every second one shifted by half a distance."""

    has_colors = False

    def __call__(self, objective: Pixels, count: int, cutoff: float, seed: int) -> Gaussians:
        """Place Gaussians; see `Placement`."""
        return gaussians_at(objective, *grid_of(objective.size, count), cutoff)


@dataclass(frozen=True)
class Random:
    """Uniform means in the image, and shapes of about a pixel, as in GaussianImage."""

    has_colors = False

    def __call__(self, objective: Pixels, count: int, cutoff: float, seed: int) -> Gaussians:
        """Place Gaussians; see `Placement`."""
        generator = np.random.default_rng(seed)
        return gaussians_at(objective, *random_shapes(objective.size, count, generator), cutoff)


DEVIATION = 0.65
"""Standard deviation of a Gaussian of a grid, relative to the square root of the area per Gaussian.
A smaller one leaves gaps; a larger one gains nothing, slows the colour solve and makes the colours
grow."""


def grid_of(size: tuple[int, int], count: int) -> Shapes:
    """Return round Gaussians in rows, every second one shifted by half a distance.

    The count may be any number: rows differ by at most one Gaussian.
    """
    width, height = size
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


def random_shapes(size: tuple[int, int], count: int, generator: np.random.Generator) -> Shapes:
    """Draw means uniformly in the image, and shapes as GaussianImage does.

    The covariance is ``L L^T`` with ``L = [[l1 + 0.5, 0], [l2, l3 + 0.5]]`` pixels and l1, l2, l3
    uniform in [0, 1].
    """
    mean = generator.uniform(0, size, (count, 2))
    l1, l2, l3 = (generator.uniform(0, 1, (count, 3)) + np.array([0.5, 0, 0.5])).T
    return mean, factor_from_covariance(l1 * l1, l1 * l2, l2 * l2 + l3 * l3)


def gaussians_at(
    objective: Pixels,
    mean: NDArray[np.floating],
    factor: NDArray[np.floating],
    cutoff: float,
    color: NDArray[np.floating] | None = None,
) -> Gaussians:
    """Return bounded Gaussians with these means and shapes for each image of a batch.

    Their colours are 0 by default.
    """
    images, types = objective.grid.images, objective.types
    if color is None:
        color = np.zeros((len(mean), objective.channels), np.float32)
    return Gaussians.from_arrays(
        *(np.tile(rows, (images, 1)) for rows in (mean, factor, color)),
        size=objective.size,
        space=objective.space,
        backend=types.backend,
        cutoff=cutoff,
        dtype=np.float32 if types.bits == 32 else np.float64,
    ).bounded()

"""Placements: where Gaussians start without a given start, before their colours are known.

`Adaptive` follows the second derivatives of the image; `Grid` and `Random` use only its size.
`lattices` makes sets without an image, for your own losses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from operator import index
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ..backend.doors import door
from ..gaussian.covariance import factor_from_covariance
from ..gaussian.file import CUTOFF
from ..gaussian.gaussians import Gaussians
from ..image.pixels import check_size
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


@door
def lattices(
    size: tuple[int, int],
    sides: Sequence[int],
    background: ArrayLike = (0.5, 0.5, 0.5),
    *,
    space: str = "ycbcr",
    cutoff: float = CUTOFF,
    backend: str | None = None,
    dtype: DTypeLike = np.float32,
) -> Gaussians:
    """Place Gaussians on lattices from wide to narrow: a set to start from without an image.

    With several lattices, the colours of few wide Gaussians move much of the picture at once, and
    those of many narrow ones add details, as the levels of a pyramid of texels.

    Parameters
    ----------
    size : (int, int)
        Native width and height in pixels.
    sides : sequence of int
        Number of Gaussians of each lattice along the longer side, such as ``(16, 40, 100)``. Along
        the other side, their number makes the distances as equal as possible, and is at least one.
    background : array_like, shape (C,), optional
        What the set shows: the colours of its Gaussians are 0. In units of the space, so that the
        default is a grey in "ycbcr" and "rgb".
    space, cutoff : optional
        See `Gaussians`.
    backend : {"llvm", "cuda"}, optional
        By default "cuda" if the machine has a CUDA GPU, else "llvm".
    dtype : {numpy.float32, numpy.float64}, optional
        Precision of the arrays.

    Returns
    -------
    Gaussians
        Lattice after lattice, row after row. Standard deviations are 0.65 distances along each
        axis, within the bounds of `Gaussians.bounded`.

    Raises
    ------
    ValueError
        If `sides` are not whole numbers above 0, or another value is not as above.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> g = eg.lattices((64, 32), (4, 8), [0.2], space="data")
    >>> len(g), g.channels, g.mean.numpy()[:, 0].tolist()
    (40, 1, [8.0, 8.0])
    """
    try:
        counts = sorted(index(n) for n in sides)
    except TypeError:
        counts = []
    if not counts or counts[0] < 1:
        raise ValueError(
            f"lattices: sides are {sides!r}; give whole numbers above 0, such as (16, 40, 100)"
        )
    longer = max(check_size(size))
    grids = [tuple(max(1, round(n * side / longer)) for side in size) for n in counts]
    mean = [(np.indices(grid).T.reshape(-1, 2) + 0.5) * size / grid for grid in grids]
    factor = [
        np.tile([nx / size[0], 0, ny / size[1]], (nx * ny, 1)) / DEVIATION for nx, ny in grids
    ]
    places, background = np.concatenate(mean), np.asarray(background)
    return Gaussians.from_arrays(
        places,
        np.concatenate(factor),
        np.zeros((len(places), background.size)),
        background,
        size=size,
        space=space,
        backend=backend,
        cutoff=cutoff,
        dtype=dtype,
    ).bounded()


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

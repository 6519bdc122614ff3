"""Placements: where Gaussians start without a given start, before their colours are known.

`Adaptive` follows the second derivatives of the image; `Grid` and `Random` use only its size.

Gaussians approximate an image well where it is nearly linear; the error comes from the second
derivatives. So the density of Gaussians follows the squared Hessian ``sum_c H_c H_c``, with the
second derivatives ``H_c`` of channel c. The means are the centroids of pieces of equal mass of a
Hilbert curve. Each Gaussian is stretched along the direction of the smallest second derivative. The
constants were chosen on training images of faces and of ImageNet classes by the error after 10
steps of the colour solve.

This runs on the host, in NumPy and SciPy: a fit places once or twice, and kernels for it were a
quarter of all that a first fit compiled (0.7 of 3.0 MB of intermediate code).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from ..backend.types import Doubles, Float, Singles
from ..gaussian.covariance import factor_from_covariance
from ..gaussian.file import CUTOFF
from ..gaussian.gaussians import Gaussians
from ..raster.tiles import TILE
from ..raster.tiles import Grid as TileGrid
from .objective import Pixels

Shapes = tuple[Doubles, Doubles]
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
    """More and smaller Gaussians where the image has large second derivatives."""

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

    Rows (N, 2) and (N, 3) are for every image; rows (images, N, 2) and (images, N, 3) hold those of
    each. Colours are 0 by default.
    """
    types = objective.types
    if color is None:
        color = np.zeros((mean.shape[-2], objective.channels), np.float32)
    return Gaussians.from_arrays(
        *(
            np.broadcast_to(rows, (objective.grid.images, *rows.shape[-2:])).reshape(
                -1, rows.shape[-1]
            )
            for rows in (mean, factor, color)
        ),
        size=objective.size,
        space=objective.space,
        backend=types.backend,
        cutoff=cutoff,
        dtype=np.float32 if types.bits == 32 else np.float64,
    ).bounded()


Density = Callable[[Singles, int], Singles]
"""``density(default, times)`` returns the Gaussians per pixel, up to a factor, of images that were
shrunk by `times`. The default follows second derivatives alone; both have the shape (images, H, W).
"""

IMAGE_BLUR = 0.18
"""Standard deviation of the blur of the image, in spacings: it removes details that no Gaussian can
follow."""

DENSITY_BLUR = 0.14
"""Standard deviation of the blur of the squared Hessian for the density, in spacings."""

DIRECTION_BLUR = 0.4
"""Standard deviation of the blur of the squared Hessian for the direction, in spacings."""

NOISE_SLOPE = 0.2
"""Isotropic noise: a change of the slope across one spacing, in units of the image."""

DENSITY_EXPONENT = 2 / 3
"""Exponent of the squared Hessian in the density."""

RELATIVE_SIZE = 0.7
"""Geometric mean of both standard deviations, relative to ``1 / sqrt(density)``."""

MAX_STRETCH = 3.0
"""Ratio of the standard deviations along and across a straight edge."""

SEED_STEP = 2654435769
"""Step of the shifts of seeds, of 2^32: the golden ratio spreads them evenly, and 0 shifts nothing
(Knuth, The Art of Computer Programming 3, 6.4)."""

WORKING_SPACING = 8.0
"""Pixels between Gaussians for placement. Images with at least twice this spacing are shrunk first:
the constants above were chosen near this spacing, and filters of large images take long."""

TRUNCATION = 2.5
"""Radius of the weights of a blur, in standard deviations."""


def place_adaptive(
    objective: Pixels,
    count: int,
    cutoff: float = CUTOFF,
    density: Density | None = None,
    seed: int = 0,
) -> Gaussians:
    """Place and shape Gaussians by the second derivatives of an image, with the colour 0.

    Parameters
    ----------
    objective : Pixels
        A batch gets the sets of all images, image after image.
    count : int
        Number of Gaussians of an image, from 1 to W H.
    cutoff : float, optional
        Cutoff of the set, see `eigengs_dr.Gaussians`.
    density : callable, optional
        See `Density`.
    seed : int, optional
        Moves all means along the curve by the same share of a piece, see `shift_of`.

    Returns
    -------
    Gaussians
        Neighbours in memory are close in space.
    """
    grid = objective.grid
    times = max(1, int(math.sqrt(grid.width * grid.height / count) / WORKING_SPACING))
    images = shrunk(planes_of(objective.placement_image, grid), times)
    spacing = math.sqrt(math.prod(images.shape[2:]) / count)
    energies, default = zip(*(density_from_hessian(i, spacing) for i in images), strict=True)
    per_pixel = np.stack(default)
    if density:
        per_pixel = density(per_pixel, times)
    placed = [
        place_by_density(*both, count, spacing, shift_of(seed))
        for both in zip(per_pixel, energies, strict=True)
    ]
    mean, factor = (np.stack(rows) for rows in zip(*placed, strict=True))
    return gaussians_at(objective, mean * times, factor / times, cutoff)


def shift_of(seed: int) -> float:
    """Return the share of a piece by which a seed moves all cuts back, from 0 to 0.5; 0 for 0."""
    folded = seed % (2**32 - 1)  # all bits of a seed count, also those above the lowest 32
    return 0.5 * (folded * SEED_STEP % 2**32) / 2**32


def planes_of(image: Float, grid: TileGrid) -> Singles:
    """Return images in tile layout as planes on the host, shape (images, C, H, W)."""
    dr.eval(image)
    width, height = TILE
    tiles = image.numpy().reshape(grid.images, grid.ny, grid.nx, height, width, -1)
    planes = tiles.transpose(0, 5, 1, 3, 2, 4).reshape(
        grid.images, -1, grid.ny * height, grid.nx * width
    )
    return np.asarray(planes[..., : grid.height, : grid.width], np.float32)


def shrunk(images: Singles, times: int) -> Singles:
    """Return the means of images (..., H, W) over squares of `times` x `times` pixels."""
    if times == 1:
        return images
    sides = images.shape[-2:]
    rows, columns = (np.arange(0, side, times) for side in sides)
    sums = np.add.reduceat(np.add.reduceat(images, rows, -2), columns, -1)
    high, wide = (np.diff([*s, n]) for s, n in zip((rows, columns), sides, strict=True))
    return np.asarray(sums / np.float32(high[:, None] * wide))


def blurred(plane: Singles, deviation: float) -> Singles:
    """Return a plane (H, W), or the last two axes of several, blurred by a Gaussian, in pixels."""
    return np.asarray(
        gaussian_filter(plane, deviation, mode="nearest", truncate=TRUNCATION, axes=(-2, -1))
    )


def density_from_hessian(image: Singles, spacing: float) -> tuple[Singles, Singles]:
    """Return the squared Hessian of an image, and the density for it, up to a factor.

    Second derivatives are differences of neighbours, those of close floats first, which are exact.
    An image continues with the pixels of its edges.

    Parameters
    ----------
    image : ndarray of float32, shape (C, H, W)
    spacing : float
        Mean distance of Gaussians in pixels.

    Returns
    -------
    energy : ndarray of float32, shape (3, H, W)
        The entries xx, yy and xy of ``sum_c H_c H_c`` plus isotropic noise.
    density : ndarray of float32, shape (H, W)
    """
    energy = np.zeros((3, *image.shape[1:]), np.float32)
    energy[:2] = (NOISE_SLOPE / spacing**2) ** 2 / 2
    for plane in image:  # one after the other, as small arrays stay in the processor's caches
        edged = np.pad(blurred(plane, IMAGE_BLUR * spacing), 1, mode="edge")
        xx = np.diff(edged[1:-1], 2, axis=1)
        yy = np.diff(edged[:, 1:-1], 2, axis=0)
        across = edged[:, 2:] - edged[:, :-2]
        xy = np.float32(0.25) * (across[2:] - across[:-2])
        energy[2] += xy * (xx + yy)
        xy *= xy
        energy[0] += xx * xx + xy
        energy[1] += yy * yy + xy
    trace = blurred(energy[0] + energy[1], DENSITY_BLUR * spacing)
    return energy, trace ** np.float32(DENSITY_EXPONENT)


def place_by_density(
    density: Singles, energy: Singles, count: int, spacing: float, shift: float
) -> tuple[Doubles, Doubles]:
    """Return means (N, 2) in pixels, and factors (N, 3), of Gaussians by a density.

    Parameters
    ----------
    density : ndarray of float32, shape (H, W)
        Up to a factor; 0 where no Gaussian may lie.
    energy : ndarray of float32, shape (3, H, W)
        The squared Hessian, from `density_from_hessian`.
    count : int
        Number of Gaussians.
    spacing : float
        Mean distance of Gaussians in pixels.
    shift : float
        See `shift_of`.
    """
    density = normalized(density, count)
    mean = centroids_along_curve(density, count, shift)
    return mean, shapes_from_hessian(mean, density, energy, spacing)


def normalized(density: Singles, count: int) -> Singles:
    """Scale a density to a sum of about `count`, with at most one Gaussian per pixel."""
    scaled = density * np.float32(count / density.sum(dtype=np.float64))
    for _ in range(4):  # each round moves the excess of full pixels to the others
        scaled *= np.float32(count / np.minimum(scaled, 1).sum(dtype=np.float64))
    return np.asarray(np.minimum(scaled, 1))


def hilbert_curve(width: int, height: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return columns and rows (W H,) of the pixels of an image in the order of a Hilbert curve.

    The curve fills the next power of two. Each level of it joins four copies of the last one: the
    first with columns and rows swapped, two as they are, the last swapped and turned by 180 degrees
    (Hilbert, Ueber die stetige Abbildung einer Linie auf ein Flaechenstueck, 1891).
    """
    x = y = np.zeros(1, np.int32)
    for level in range((max(width, height) - 1).bit_length()):
        side = 1 << level
        x, y = (
            np.concatenate([y, x, x + side, 2 * side - 1 - y]),
            np.concatenate([x, y + side, y + side, side - 1 - x]),
        )
    inside = (x < width) & (y < height)
    return x[inside], y[inside]


def centroids_along_curve(density: Singles, count: int, shift: float) -> Doubles:
    """Cut a Hilbert curve through the pixels into pieces of equal mass; return their centroids.

    All cuts but the two ends move back by `shift` of a piece. The centroids (count, 2), in pixels,
    are in the order of the curve: neighbours in memory are close in space.
    """
    column, row = hilbert_curve(density.shape[1], density.shape[0])
    mass = density[row, column].astype(np.float64)
    before = np.concatenate([[0], np.cumsum(mass)])
    cuts = np.arange(count + 1.0)
    cuts[1:-1] -= shift
    cuts *= before[-1] / count
    # A curve that stands still where the density is 0 has several places for one mass; the moments
    # of all of them are the same.
    moments = [
        np.interp(cuts, before, np.concatenate([[0], np.cumsum(mass * (place + 0.5))]))
        for place in (column, row)
    ]
    centroids = np.diff(moments) / np.diff(cuts)
    return np.asarray(centroids.T)


def shapes_from_hessian(
    mean: Doubles, density: Singles, energy: Singles, spacing: float
) -> Doubles:
    """Return factors: size by the density, ratio and angle of the axes by the squared Hessian."""
    height, width = density.shape
    x, y = np.minimum(mean.astype(np.int64), [width - 1, height - 1]).T
    xx, yy, xy = blurred(energy, DIRECTION_BLUR * spacing)[:, y, x].astype(np.float64)
    # The eigenvalues of the energy differ by `split`; the larger one belongs to the direction with
    # the cosine and the sine of twice its angle.
    split = np.hypot(xx - yy, 2 * xy)
    cos, sin = (np.divide(v, split, np.zeros_like(v), where=split > 0) for v in (xx - yy, 2 * xy))
    ratio = 1 + (MAX_STRETCH - 1) * split / (xx + yy)
    variance = RELATIVE_SIZE**2 / density[y, x].astype(np.float64)
    middle, half = variance * (ratio + 1 / ratio) / 2, variance * (ratio - 1 / ratio) / 2
    return factor_from_covariance(middle - half * cos, -half * sin, middle + half * cos)

"""Splats placed and shaped by the image: many, small and stretched where it bends the most.

A Gaussian follows an image where that is nearly linear; what it misses is the second derivative. So
the density of splats follows the squared Hessian (`hessian_energy`), their centres cut a
space-filling curve into pieces of equal mass and take one Lloyd step, and each is stretched along
the direction that bends the least. The constants were chosen on training images of faces and of
ImageNet classes by the error after 10 steps of the colour solve.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...gaussian.covariance import factor_from_covariance
from ...image.resize import resample
from .hilbert_scan import hilbert_order

Array = NDArray[np.floating]
Density = Callable[[Array, float], Array]

IMAGE_BLUR = 0.18
"""Standard deviation, in splat spacings, of what no splat can follow."""

DENSITY_BLUR = 0.14
"""Over how many spacings the bending is averaged for the density."""

DIRECTION_BLUR = 0.4
"""Over how many spacings it is averaged for the direction."""

NOISE_SLOPE = 0.2
"""Change of slope across a spacing that counts as noise, without direction; the pixels' unit."""

DENSITY_EXPONENT = 2 / 3
"""Density is the squared Hessian to this power."""

RELATIVE_SIZE = 0.7
"""Geometric mean of both standard deviations over ``1 / sqrt(density)``."""

MAX_STRETCH = 3.0
"""Ratio of the standard deviations along and across a straight edge."""

WORKING_SPACING = 8.0
"""Pixels between splats that are enough to place them: larger images are shrunk first, for the
constants above were chosen at such a spacing, and filters of large images take long."""


def place_adaptive(
    image: Array,
    count: int,
    generator: np.random.Generator | None = None,
    density: Density | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Place and shape splats by the second derivatives of an image.

    Parameters
    ----------
    image : ndarray, shape (H, W, C)
        In the space whose squared error counts.
    count : int
        Number of splats, from 1 to H W.
    generator : numpy.random.Generator, optional
        Not used: the result is a function of the image.
    density : callable, optional
        ``density(bend, spacing)`` returns splats a pixel, up to a factor, of the shape of the image
        or of a smaller one; by default `density_from_hessian`.

    Returns
    -------
    mean : ndarray, shape (count, 2)
        In pixels, centres at +0.5.
    factor : ndarray, shape (count, 3)
        a, b, c in 1 / pixels; see `eigengs_dr.Gaussians`.
    """
    height, width = image.shape[:2]
    spacing = float(np.sqrt(height * width / count))
    if spacing >= 2 * WORKING_SPACING:
        times = int(spacing / WORKING_SPACING)
        size = -(-width // times), -(-height // times)
        small = resample(image.astype(np.float32), *size)
        mean, factor = place_adaptive(small, count, density=density)
        x, y = width / small.shape[1], height / small.shape[0]
        return mean * (x, y), factor / (x, y, y)
    bend = hessian_energy(image, spacing)
    splats = normalize_density((density or density_from_hessian)(bend, spacing), count)
    mean = lloyd_step(stratify_along_hilbert(splats, count), splats)
    return mean, shapes_from_hessian(mean, splats, bend, spacing)


def hessian_energy(image: Array, spacing: float) -> NDArray[np.float32]:
    """Squared Hessian ``sum_c H_c H_c`` of a blurred image plus isotropic noise.

    Returns
    -------
    ndarray of float32, shape (3, H, W)
        Its entries xx, yy and xy.
    """
    from scipy.ndimage import correlate1d, gaussian_filter

    channels = np.moveaxis(image, 2, 0).astype(np.float32)
    channels = gaussian_filter(channels, (0, IMAGE_BLUR * spacing, IMAGE_BLUR * spacing))
    slope, bend = [-0.5, 0.0, 0.5], [1.0, -2.0, 1.0]
    xx = correlate1d(channels, bend, axis=2, mode="nearest")
    yy = correlate1d(channels, bend, axis=1, mode="nearest")
    xy = correlate1d(correlate1d(channels, slope, 2, mode="nearest"), slope, 1, mode="nearest")
    noise = (NOISE_SLOPE / spacing**2) ** 2 / 2
    squared = np.stack([xx * xx + xy * xy, yy * yy + xy * xy, xy * (xx + yy)]).sum(axis=1)
    return squared + np.array([noise, noise, 0], np.float32)[:, None, None]


def density_from_hessian(bend: Array, spacing: float) -> Array:
    """Density that the bending asks for, shape (H, W), up to a factor."""
    from scipy.ndimage import gaussian_filter

    mean = gaussian_filter(bend[0] + bend[1], DENSITY_BLUR * spacing)
    return np.power(mean, DENSITY_EXPONENT, dtype=np.float64)


def normalize_density(density: Array, count: int) -> NDArray[np.float64]:
    """Scale a density to `count` splats in all, or a little less where most pixels have one."""
    splats: NDArray[np.float64] = density.astype(np.float64)
    for _ in range(5):  # what is cut off above goes to the rest
        splats = np.minimum(splats * (count / splats.sum()), 1.0)
    return splats


def stratify_along_hilbert(density: Array, count: int) -> NDArray[np.float64]:
    """Cut a Hilbert curve through the pixels into pieces of equal mass.

    Returns
    -------
    ndarray, shape (count, 2)
        Their centroids, in the order of the curve: neighbours in memory are neighbours in space.
    """
    height, width = density.shape
    order = hilbert_order(height, width)
    mass = density.ravel()[order]
    total = np.concatenate([[0.0], np.cumsum(mass)])
    cuts = np.linspace(0, total[-1], count + 1)

    def centroid(position: Array) -> Array:
        moment = np.concatenate([[0.0], np.cumsum(mass * position)])
        return np.diff(np.interp(cuts, total, moment)) * (count / total[-1])

    return np.stack([centroid(order % width + 0.5), centroid(order // width + 0.5)], axis=1)


def lloyd_step(mean: Array, density: Array) -> NDArray[np.float64]:
    """One Lloyd step: each centre moves to the centroid of the pixels nearest to it."""
    count = len(mean)
    owner = nearest_center(mean, density.shape)
    rows, columns = np.indices(density.shape).reshape(2, -1)
    mass = np.bincount(owner, density.ravel(), count)
    moment = [np.bincount(owner, density.ravel() * (v + 0.5), count) for v in (columns, rows)]
    moves = mass > 0
    result = np.array(mean, np.float64)
    result[moves] = np.stack(moment, axis=1)[moves] / mass[moves, None]
    return result


def nearest_center(mean: Array, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Index of the centre nearest to each pixel, shape (H W,); of several in one pixel the last."""
    from scipy.ndimage import distance_transform_edt

    column, row = _pixels(mean, shape)
    owner = np.full(shape, -1)
    owner[row, column] = np.arange(len(mean))
    y, x = distance_transform_edt(owner < 0, return_distances=False, return_indices=True)
    return owner[y, x].ravel()


def shapes_from_hessian(
    mean: Array, density: Array, bend: Array, spacing: float
) -> NDArray[np.float64]:
    """Shape the splats: size by the density, ratio and angle of the axes by the bending."""
    from scipy.ndimage import gaussian_filter

    column, row = _pixels(mean, density.shape)
    xx, yy, xy = (
        gaussian_filter(b, DIRECTION_BLUR * spacing)[row, column].astype(float) for b in bend
    )
    split = np.hypot(xx - yy, 2 * xy)
    ratio = 1 + (MAX_STRETCH - 1) * split / (xx + yy)
    variance = RELATIVE_SIZE**2 / density[row, column]
    along, across = variance * ratio, variance / ratio
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)  # of the direction that bends the most
    cos, sin = np.cos(angle), np.sin(angle)
    return factor_from_covariance(
        across * cos**2 + along * sin**2,
        (across - along) * cos * sin,
        across * sin**2 + along * cos**2,
    )


def _pixels(mean: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Columns and rows of the pixels that centres lie in."""
    column = np.clip(mean[:, 0].astype(int), 0, shape[1] - 1)
    return column, np.clip(mean[:, 1].astype(int), 0, shape[0] - 1)

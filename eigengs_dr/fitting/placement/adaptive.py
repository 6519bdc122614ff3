"""Adaptive placement: more and smaller Gaussians where the image has large second derivatives.

Gaussians approximate an image well where it is nearly linear; the error comes from the second
derivatives. So the density of Gaussians follows the squared Hessian (`hessian_energy`). The means
are the centroids of pieces of equal mass of a Hilbert curve, after one Lloyd step. Each Gaussian is
stretched along the direction of the smallest second derivative. The constants were chosen on
training images of faces and of ImageNet classes by the error after 10 steps of the colour solve.
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

WORKING_SPACING = 8.0
"""Pixels between Gaussians for placement. Images with at least twice this spacing are shrunk first:
the constants above were chosen near this spacing, and filters of large images take long."""


def place_adaptive(
    image: Array,
    count: int,
    generator: np.random.Generator | None = None,
    density: Density | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Place and shape Gaussians by the second derivatives of an image.

    Parameters
    ----------
    image : ndarray, shape (H, W, C)
        Image in the space of the squared error.
    count : int
        Number of Gaussians, from 1 to H W.
    generator : numpy.random.Generator, optional
        Not used: the result is a function of the image.
    density : callable, optional
        ``density(bend, spacing)`` returns the Gaussians per pixel, up to a factor, for the result
        of `hessian_energy` on the image or on a smaller one; by default `density_from_hessian`.

    Returns
    -------
    mean : ndarray, shape (count, 2)
        In pixels; pixel centres lie at +0.5.
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
    per_pixel = normalize_density((density or density_from_hessian)(bend, spacing), count)
    mean = lloyd_step(stratify_along_hilbert(per_pixel, count), per_pixel)
    return mean, shapes_from_hessian(mean, per_pixel, bend, spacing)


def hessian_energy(image: Array, spacing: float) -> NDArray[np.float32]:
    """Return the squared Hessian ``sum_c H_c H_c`` of a blurred image plus isotropic noise.

    Parameters
    ----------
    image : ndarray, shape (H, W, C)
    spacing : float
        Distance between Gaussians in pixels.

    Returns
    -------
    ndarray of float32, shape (3, H, W)
        The entries xx, yy and xy.
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
    """Return the density (H, W) for a squared Hessian, up to a factor; see `hessian_energy`."""
    from scipy.ndimage import gaussian_filter

    mean = gaussian_filter(bend[0] + bend[1], DENSITY_BLUR * spacing)
    return np.power(mean, DENSITY_EXPONENT, dtype=np.float64)


def normalize_density(density: Array, count: int) -> NDArray[np.float64]:
    """Scale a density to a sum of about `count` Gaussians, with at most one per pixel."""
    per_pixel: NDArray[np.float64] = density.astype(np.float64)
    for _ in range(5):  # each round moves the excess of full pixels to the others
        per_pixel = np.minimum(per_pixel * (count / per_pixel.sum()), 1.0)
    return per_pixel


def stratify_along_hilbert(density: Array, count: int) -> NDArray[np.float64]:
    """Cut a Hilbert curve through the pixels into pieces of equal mass, and return their centroids.

    Returns
    -------
    ndarray of float64, shape (count, 2)
        Centroids in pixels, in the order of the curve: neighbours in memory are close in space.
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
    """Take one Lloyd step: move each centre to the centroid of the pixels nearest to it."""
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
    """Return the index of the centre nearest to each pixel, shape (H W,).

    If several centres lie in one pixel, only the last counts.
    """
    from scipy.ndimage import distance_transform_edt

    column, row = _pixels(mean, shape)
    owner = np.full(shape, -1)
    owner[row, column] = np.arange(len(mean))
    y, x = distance_transform_edt(owner < 0, return_distances=False, return_indices=True)
    return owner[y, x].ravel()


def shapes_from_hessian(
    mean: Array, density: Array, bend: Array, spacing: float
) -> NDArray[np.float64]:
    """Return factors (N, 3): size by the density, ratio and angle of the axes by the Hessian."""
    from scipy.ndimage import gaussian_filter

    column, row = _pixels(mean, density.shape)
    xx, yy, xy = (
        gaussian_filter(b, DIRECTION_BLUR * spacing)[row, column].astype(float) for b in bend
    )
    split = np.hypot(xx - yy, 2 * xy)
    ratio = 1 + (MAX_STRETCH - 1) * split / (xx + yy)
    variance = RELATIVE_SIZE**2 / density[row, column]
    along, across = variance * ratio, variance / ratio
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)  # the direction of the largest second derivative
    cos, sin = np.cos(angle), np.sin(angle)
    return factor_from_covariance(
        across * cos**2 + along * sin**2,
        (across - along) * cos * sin,
        across * sin**2 + along * cos**2,
    )


def _pixels(mean: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Return the columns and rows of the pixels of the centres."""
    column = np.clip(mean[:, 0].astype(int), 0, shape[1] - 1)
    return column, np.clip(mean[:, 1].astype(int), 0, shape[0] - 1)

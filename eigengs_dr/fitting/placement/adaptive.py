"""Adaptive placement: more and smaller Gaussians where the image has large second derivatives.

Gaussians approximate an image well where it is nearly linear; the error comes from the second
derivatives. So the density of Gaussians follows the squared Hessian (`hessian_energy`). The means
are the centroids of pieces of equal mass of a Hilbert curve, after one Lloyd step. Each Gaussian is
stretched along the direction of the smallest second derivative. The constants were chosen on
training images of faces and of ImageNet classes by the error after 10 steps of the colour solve.

Redistribution places the Gaussians of a fit anew, denser where the fit left more error. At a
density of rho Gaussians per pixel, a fit leaves a squared error of about ``e = k rho^-q`` per
pixel, with q = `eigengs_dr.fitting.placement.density.ERROR_EXPONENT`. For a given number of
Gaussians, the sum of the errors is smallest if all Gaussians have the same error ``s = e / rho``.
So the density and the error of one fit give the best density:

    rho' ~ k^(1 / (q + 1)) = rho s^(1 / (q + 1)).

Only a fit can tell parts that are hard to fit from parts that just have large second derivatives.
The errors of several neighbouring Gaussians are averaged; between these Gaussians, the density
follows the second derivatives. The constants were chosen on training images of ImageNet classes
and of cats, by the error after 1,000 steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...gaussian.covariance import factor_from_covariance
from ...gaussian.gaussians import Gaussians, like
from ...image.hilbert import Square, hilbert_squares
from ...image.metrics import blur, gaussian_taps
from ...image.resize import resample
from ...image.strips import map_threads, strips, with_border
from ...raster.render import render
from ..solvers.conjugate_gradient import solve
from .density import center_pixels, nearest_center, sum_by_center, target_density

Array = NDArray[np.floating]
Density = Callable[[Array], Array]

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

    Beside the image, the function holds about 15 bytes per pixel.

    Parameters
    ----------
    image : ndarray, shape (H, W, C)
        Image in the space of the squared error.
    count : int
        Number of Gaussians, from 1 to H W.
    generator : numpy.random.Generator, optional
        Not used: the result is a function of the image.
    density : callable, optional
        ``density(default)`` returns the Gaussians per pixel, up to a factor, for the density (H, W)
        by `density_from_hessian` of the image or of a smaller one, which it may overwrite.

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
        small = resample(image.astype(np.float32, copy=False), *size)
        mean, factor = place_adaptive(small, count, density=density)
        x, y = width / small.shape[1], height / small.shape[0]
        return mean * (x, y), factor / (x, y, y)
    per_pixel = density_from_hessian(image, spacing)
    per_pixel = normalize_density(density(per_pixel) if density else per_pixel, count)
    mean = lloyd_step(stratify_along_hilbert(per_pixel, count), per_pixel)
    return mean, shapes_from_hessian(mean, per_pixel, image, spacing)


def hessian_energy(image: Array, spacing: float, rows: slice | None = None) -> NDArray[np.float32]:
    """Return the squared Hessian ``sum_c H_c H_c`` of a blurred image plus isotropic noise.

    Parameters
    ----------
    image : ndarray, shape (H, W, C)
    spacing : float
        Distance between Gaussians in pixels.
    rows : slice, optional
        Rows of the image to compute; by default all.

    Returns
    -------
    ndarray of float32, shape (3, R, W)
        The entries xx, yy and xy.
    """
    height, width, channels = image.shape
    rows = slice(0, height) if rows is None else rows
    taps = gaussian_taps(IMAGE_BLUR * spacing)
    noise = (NOISE_SLOPE / spacing**2) ** 2 / 2
    energy = np.empty((3, rows.stop - rows.start, width), np.float32)
    energy[:2], energy[2] = noise, 0
    for channel in range(channels):

        def plane(part: slice, channel: int = channel) -> NDArray[np.float32]:
            return image[part, :, channel].astype(np.float32, order="C")

        xx, yy, xy = _hessian(blur(with_border(plane, rows, height, len(taps)), taps))
        across = xy * xy
        energy[0] += xx * xx + across
        energy[1] += yy * yy + across
        xy *= xx + yy
        energy[2] += xy
    return energy


def _hessian(plane: Array) -> tuple[Array, Array, Array]:
    """Return the second differences xx, yy and xy of a plane without its outermost pixels."""
    middle = plane[1:-1, 1:-1]
    # Differences of neighbours first: those of close floats are exact.
    xx = (plane[1:-1, 2:] - middle) - (middle - plane[1:-1, :-2])
    yy = (plane[2:, 1:-1] - middle) - (middle - plane[:-2, 1:-1])
    slope = 0.5 * (plane[:, 2:] - plane[:, :-2])
    return xx, yy, 0.5 * (slope[2:] - slope[:-2])


def density_from_hessian(image: Array, spacing: float) -> NDArray[np.float32]:
    """Return the density (H, W) by the squared Hessian of an image (H, W, C), up to a factor."""
    height, width = image.shape[:2]
    taps = gaussian_taps(DENSITY_BLUR * spacing)
    density = np.empty((height, width), np.float32)

    def trace(rows: slice) -> Array:
        bend = hessian_energy(image, spacing, rows)
        return np.asarray(bend[0] + bend[1])

    def fill(rows: slice) -> None:
        mean = blur(with_border(trace, rows, height, len(taps) - 1), taps)
        np.power(mean, np.float32(DENSITY_EXPONENT), out=density[rows])

    map_threads(fill, strips(height, width))
    return density


def normalize_density(density: Array, count: int) -> NDArray[np.float32]:
    """Scale a density to a sum of about `count` Gaussians, with at most one per pixel.

    An array of float32 is scaled in place, and returned.
    """
    per_pixel = density.astype(np.float32, copy=False)
    parts = strips(*per_pixel.shape)
    factor = count / sum(map_threads(lambda rows: per_pixel[rows].sum(dtype=np.float64), parts))

    def scaled(rows: slice) -> Array:
        return np.minimum(per_pixel[rows] * np.float32(factor), np.float32(1))

    for _ in range(4):  # each round moves the excess of full pixels to the others
        factor *= count / sum(map_threads(lambda rows: scaled(rows).sum(dtype=np.float64), parts))

    def scale(rows: slice) -> None:
        per_pixel[rows] = scaled(rows)

    map_threads(scale, parts)
    return per_pixel


def stratify_along_hilbert(density: Array, count: int) -> NDArray[np.float64]:
    """Cut a Hilbert curve through the pixels into pieces of equal mass, and return their centroids.

    Returns
    -------
    ndarray of float64, shape (count, 2)
        Centroids in pixels, in the order of the curve: neighbours in memory are close in space.
    """
    squares = hilbert_squares(*density.shape)
    mass = map_threads(
        lambda square: density[square.rows, square.columns].sum(dtype=np.float64), squares
    )
    begin = np.concatenate([[0.0], np.cumsum(mass)])
    cuts = np.linspace(0, begin[-1], count + 1)
    first = np.searchsorted(cuts, begin)
    first[-1] = count + 1
    moments = np.empty((count + 1, 2))

    def integrate(number: int) -> Array:
        """Fill in the moments of the curve from the start of a square to the cuts in it."""
        own = slice(first[number], first[number + 1])
        moments[own], total = _moments(density, squares[number], cuts[own] - begin[number])
        return total

    totals = np.array(map_threads(integrate, range(len(squares))))
    before = np.cumsum(totals, axis=0) - totals
    for number in range(len(squares)):
        moments[first[number] : first[number + 1]] += before[number]
    return np.diff(moments, axis=0) * (count / begin[-1])


def _moments(density: Array, square: Square, cuts: Array) -> tuple[Array, Array]:
    """Return the moments (n, 2) of a square up to some masses along the curve, and its total."""
    row, column = square.order()
    mass = density[square.rows, square.columns][row, column].astype(np.float64)
    mass_before = np.concatenate([[0.0], np.cumsum(mass)])
    # The curve visits pixels, so the moment is linear in the mass between the ends of a pixel.
    found, totals = np.empty((len(cuts), 2)), np.empty(2)
    for axis, position in enumerate((column + square.columns.start, row + square.rows.start)):
        moment = np.concatenate([[0.0], np.cumsum(mass * (position + 0.5))])
        found[:, axis] = np.interp(cuts, mass_before, moment)
        totals[axis] = moment[-1]
    return found, totals


def lloyd_step(mean: Array, density: Array) -> NDArray[np.float64]:
    """Take one Lloyd step: move each centre to the centroid of the pixels nearest to it."""
    height, width = density.shape
    owner = nearest_center(mean, density.shape)
    x, y = np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5
    mass, *moments = sum_by_center(owner, len(mean), [(density,), (density, x), (density, y)])
    result = np.array(mean, np.float64)
    moves = mass > 0
    for axis in (0, 1):
        result[moves, axis] = moments[axis][moves] / mass[moves]
    return result


def shapes_from_hessian(
    mean: Array, density: Array, image: Array, spacing: float
) -> NDArray[np.float64]:
    """Return factors (N, 3): size by the density, ratio and angle of the axes by the Hessian."""
    height, width = density.shape
    column, row = center_pixels(mean, density.shape)
    taps = gaussian_taps(DIRECTION_BLUR * spacing)
    order = np.argsort(row, kind="stable")
    rows_in_order = row[order]
    factor = np.empty((len(mean), 3))

    def energy(rows: slice) -> Array:
        return hessian_energy(image, spacing, rows)

    def fill(rows: slice) -> None:
        first, last = np.searchsorted(rows_in_order, [rows.start, rows.stop])
        own = order[first:last]
        bend = blur(with_border(energy, rows, height, len(taps) - 1), taps)
        bend = bend[:, row[own] - rows.start, column[own]].astype(np.float64)
        factor[own] = _factors(bend, density[row[own], column[own]].astype(np.float64))

    map_threads(fill, strips(height, width))
    return factor


def _factors(bend: Array, density: Array) -> NDArray[np.float64]:
    """Return factors (N, 3) for squared Hessians (3, N) and densities (N,)."""
    xx, yy, xy = bend
    split = np.hypot(xx - yy, 2 * xy)
    ratio = 1 + (MAX_STRETCH - 1) * split / (xx + yy)
    variance = RELATIVE_SIZE**2 / density
    along, across = variance * ratio, variance / ratio
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)  # the direction of the largest second derivative
    cos, sin = np.cos(angle), np.sin(angle)
    return factor_from_covariance(
        across * cos**2 + along * sin**2,
        (across - along) * cos * sin,
        across * sin**2 + along * cos**2,
    )


def redistribute(
    gaussians: Gaussians,
    count: int,
    image: Array,
    target: NDArray[np.float32],
    weight: Array | None = None,
    solve_steps: int = 10,
) -> Gaussians:
    """Place a new set, denser where the old set left more error, and solve for its colours.

    Parameters
    ----------
    gaussians : Gaussians
        The old set, after some steps of a fit.
    count : int
        Number of Gaussians of the new set, from 1 to H W.
    image : ndarray, shape (H, W, C)
        The image that shapes the Gaussians, see `eigengs_dr.fitting.placement.adaptive`.
    target : ndarray of float32, shape (H, W, C)
        The image in the space of the set.
    weight : ndarray, shape (H, W, C), optional
        Factor of the errors before squaring.
    solve_steps : int, optional
        Steps of the colour solve, see `eigengs_dr.fitting.solvers.conjugate_gradient`.

    Returns
    -------
    Gaussians
        The new set. It keeps no Gaussian of the old set.
    """
    placed = place_by_error(gaussians, count, image, target, weight)
    return solve(placed, target, solve_steps).gaussians


def place_by_error(
    gaussians: Gaussians,
    count: int,
    image: Array,
    target: NDArray[np.float32],
    weight: Array | None = None,
) -> Gaussians:
    """Place the set of `redistribute`, with the colour 0."""
    error = squared_error(residual(gaussians, target), weight)
    density = density_for_error(gaussians.to_arrays()["mean"], error)
    return place_like(gaussians, image, count, density)


def density_for_error(mean: Array, error: NDArray[np.float32]) -> Density:
    """Return the density of a new set for the means (N, 2) and the error (H, W) of the old set."""

    def density(default: Array) -> Array:
        height, width = default.shape
        if (height, width) == error.shape:
            return target_density(mean, error, default)
        # The placement shrinks the image.
        there = mean * np.array([width / error.shape[1], height / error.shape[0]])
        here = np.maximum(resample(error[..., None], width, height)[..., 0], 0)
        return target_density(there, here, default)

    return density


def place_like(
    gaussians: Gaussians, image: Array, count: int, density: Density | None = None
) -> Gaussians:
    """Place Gaussians by an image in the space and size of another set, with the colour 0.

    For the parameters see `redistribute` and `place_adaptive`.
    """
    mean, factor = place_adaptive(image, count, density=density)
    placed = like(gaussians, mean, factor, np.zeros((count, gaussians.channels), np.float32))
    return placed.bounded()


def residual(gaussians: Gaussians, target: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the target minus the rendering of a set, both in its space: shape (H, W, C)."""
    shown = render(replace(dr.detach(gaussians), space="data"))
    return np.asarray(target - shown.numpy(), np.float32)


def squared_error(missed: Array, weight: Array | None = None) -> NDArray[np.float32]:
    """Return the sum of the squares of the channels of a residual (H, W, C): shape (H, W).

    The weight, of the same shape, is a factor of the errors before squaring.
    """
    error = np.zeros(missed.shape[:2], np.float32)

    def add_up(rows: slice) -> None:
        for channel in range(missed.shape[2]):
            part = missed[rows, :, channel]
            part = part if weight is None else part * weight[rows, :, channel]
            error[rows] += np.square(part)

    map_threads(add_up, strips(*missed.shape[:2]))
    return error

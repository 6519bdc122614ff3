"""Adaptive placement: more and smaller Gaussians where the image has large second derivatives.

Gaussians approximate an image well where it is nearly linear; the error comes from the second
derivatives. So the density of Gaussians follows the squared Hessian
(`eigengs_dr.fitting.placement.filters`). The means are the centroids of pieces of equal mass of a
Hilbert curve, after one Lloyd step (`eigengs_dr.fitting.placement.pieces`). Each Gaussian is
stretched along the direction of the smallest second derivative. The constants were chosen on
training images of faces and of ImageNet classes by the error after 10 steps of the colour solve.

Redistribution places the Gaussians of a fit anew, denser where the fit left more error. At a
density of rho Gaussians per pixel, a fit leaves a squared error of about ``e = k rho^-q`` per
pixel, with q = `eigengs_dr.fitting.placement.density.ERROR_EXPONENT`. For a given number of
Gaussians, the sum of the errors is smallest if all Gaussians have the same error ``s = e / rho``.
So the density and the error of one fit give the best density:

    rho' ~ k^(1 / (q + 1)) = rho s^(1 / (q + 1)).

Only a fit can tell parts that are hard to fit from parts that merely have large second derivatives.
Neighbouring Gaussians share their errors, see `eigengs_dr.fitting.placement.density.Owners`; in
what a Gaussian owns, the density follows the second derivatives. The constants were chosen on
training images of ImageNet classes and of cats, by the error after 1,000 steps.

Images are in tile layout, and everything runs on the device. A batch of images takes one launch of
each kernel; no sum of one depends on another.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import drjit as dr

from ...backend.arrays import ArrayTypes, release_memory
from ...backend.recording import record
from ...backend.types import Float, Rows
from ...gaussian.file import CUTOFF
from ...gaussian.gaussians import Gaussians
from ...raster.binning.tiles import Grid
from ...raster.kernels import sum_by_image
from ...raster.parameters import gather_run
from ..objective import Pixels
from ..solve import solve, spread
from .density import Owners, squared_error, target_density
from .filters import PIXELS, Canvas, blur, shrunk, squared_hessian
from .pieces import lloyd_step, pixel_of, stratify_along_hilbert

Density = Callable[[Canvas, Float, int], Float]
"""``density(canvas, default, times)`` returns the Gaussians per pixel, up to a factor, for the
density by `density_from_hessian` of an image, which was shrunk by `times`; all in tile layout."""

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


def place_adaptive(
    objective: Pixels,
    count: int,
    cutoff: float = CUTOFF,
    density: Density | None = None,
    seed: int = 0,
) -> Gaussians:
    """Place and shape Gaussians by the second derivatives of an image, with the colour 0.

    Everything runs on the device, without a copy to the host.

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
        Moves all means along the curve by the same share of a piece, see `SEED_STEP`.

    Returns
    -------
    Gaussians
        Neighbours in memory are close in space.
    """
    types, grid, channels = objective.types, objective.grid, objective.channels
    canvas, image = Canvas.of(types, grid), objective.placement_image
    mean, factor = _place(canvas, image, count, density, seed)
    color = [dr.zeros(types.Float, grid.images * count) for _ in range(channels)]
    background = [dr.zeros(types.Float, grid.images) for _ in range(channels)]
    dr.make_opaque(color, background)
    rows = types.FloatX(color), types.FloatX(background)
    placed = Gaussians(mean, factor, *rows, *objective.size, objective.space, float(cutoff))
    placed = placed.bounded()
    dr.eval(placed)
    release_memory(
        dr.width(objective.placement_image)
    )  # nothing later asks for blocks of these sizes
    return placed


def _place(
    canvas: Canvas,
    image: Float,
    count: int,
    density: Density | None,
    seed: int,
    times: int = 1,
) -> tuple[Rows, Rows]:
    """Return the means and the factors of `place_adaptive`, for an image after shrinking."""
    types, grid = canvas.types, canvas.grid
    spacing = math.sqrt(grid.width * grid.height / count)
    smaller = int(spacing / WORKING_SPACING)
    if smaller > 1:
        small = Grid(-(-grid.width // smaller), -(-grid.height // smaller), images=grid.images)
        less = Canvas.of(types, small)
        image = shrunk(canvas, image, less, smaller)
        mean, factor = _place(less, image, count, density, seed, smaller * times)
        scale, inverse = (dr.opaque(types.Float, v) for v in (smaller, 1 / smaller))
        return mean * scale, factor * inverse
    energy, per_pixel = density_from_hessian(canvas, image, spacing)
    del image  # images take most of the memory
    if density:
        per_pixel = density(canvas, per_pixel, times)
    return place_by_density(canvas, per_pixel, energy, count, spacing, shift_of(types, seed))


def shift_of(types: ArrayTypes, seed: int) -> Float:
    """Return the shift of a seed, see `stratify_along_hilbert`; that of seed 0 is 0."""
    return dr.opaque(types.Float, 0.5 * (seed * SEED_STEP % 2**32) / 2**32)


@record
def place_by_density(
    canvas: Canvas, density: Float, energy: Float, count: int, spacing: float, shift: Float
) -> tuple[Rows, Rows]:
    """Return means, an Array2f, and factors, an Array3f, of Gaussians by a density.

    Parameters
    ----------
    canvas : Canvas
    density : Float, shape (pixels,)
        Up to a factor; 0 where no Gaussian may lie.
    energy : Float, shape (pixels * 3,)
        The squared Hessian, from `density_from_hessian`.
    count : int
        Number of Gaussians of an image.
    spacing : float
        Mean distance of Gaussians in pixels.
    shift : Float, shape (1,)
        See `stratify_along_hilbert`.
    """
    density = normalize_density(canvas, density, count)
    mean = stratify_along_hilbert(canvas, density, count, shift)
    mean = lloyd_step(canvas, mean, density, spacing)
    release_memory(dr.width(energy))  # the blur of the energy takes the most
    factor = shapes_from_hessian(canvas, mean, density, energy, spacing)
    return canvas.types.Float2(mean), factor


@record
def density_from_hessian(canvas: Canvas, image: Float, spacing: float) -> tuple[Float, Float]:
    """Return the squared Hessian of an image, and the density for it, up to a factor.

    Parameters
    ----------
    canvas : Canvas
    image : Float, shape (pixels * channels,)
        In tile layout.
    spacing : float
        Mean distance of Gaussians in pixels.

    Returns
    -------
    energy : Float, shape (pixels * 3,)
        See `eigengs_dr.fitting.placement.filters.squared_hessian`.
    density : Float, shape (pixels,)
        0 outside the image.
    """
    noise = (NOISE_SLOPE / spacing**2) ** 2 / 2
    energy, trace = squared_hessian(canvas, blur(canvas, image, IMAGE_BLUR * spacing), noise)
    trace = blur(canvas, trace, DENSITY_BLUR * spacing)
    inside = canvas.pixels()[-1]
    density = dr.select(inside, dr.exp2(DENSITY_EXPONENT * dr.log2(trace)), 0)
    dr.eval(density)
    return energy, density


def normalize_density(canvas: Canvas, density: Float, count: int) -> Float:
    """Scale a density to a sum of about `count` per image, with at most one Gaussian per pixel."""
    types, grid = canvas.types, canvas.grid
    total = dr.opaque(types.Float, count)
    values = types.FloatX(gather_run(types, density, canvas.tile, PIXELS, True))
    image = canvas.sizes.image_of(canvas.tile)

    def scaled(factor: Float) -> Float:
        return dr.minimum(values * spread(factor, image), 1)

    factor = total / sum_by_image(dr.sum(values, axis=0), grid)
    for _ in range(4):  # each round moves the excess of full pixels to the others
        factor *= total / sum_by_image(dr.sum(scaled(factor), axis=0), grid)
    result = dr.empty(types.Float, dr.width(density))
    dr.scatter(result, scaled(factor), canvas.tile)
    dr.eval(result)
    return result


def shapes_from_hessian(
    canvas: Canvas, mean: tuple[Float, Float], density: Float, energy: Float, spacing: float
) -> Rows:
    """Return factors: size by the density, ratio and angle of the axes by the squared Hessian."""
    types = canvas.types
    energy = blur(canvas, energy, DIRECTION_BLUR * spacing)
    place, _, _ = pixel_of(canvas, mean)
    xx, yy, xy = (dr.gather(types.Float, energy, place * 3 + k) for k in range(3))
    # The eigenvalues of the energy differ by `split`; the larger one belongs to the direction with
    # the cosine and the sine of twice its angle.
    split = dr.sqrt(dr.square(xx - yy) + dr.square(2 * xy))
    cos, sin = (dr.select(split > 0, v / split, 0) for v in (xx - yy, 2 * xy))
    ratio = 1 + (MAX_STRETCH - 1) * split / (xx + yy)
    variance = RELATIVE_SIZE**2 / dr.gather(types.Float, density, place)
    along, across = variance * ratio, variance / ratio
    middle, half = 0.5 * (along + across), 0.5 * (along - across)
    sigma_yy, sigma_xy = middle + half * cos, -half * sin
    a = dr.sqrt(sigma_yy) / variance
    factor = types.Float3(a, -sigma_xy / sigma_yy * a, 1 / dr.sqrt(sigma_yy))
    dr.eval(factor)
    return factor


def redistribute(
    gaussians: Gaussians, objective: Pixels, count: int, solve_steps: int = 10
) -> Gaussians:
    """Place a new set, denser where the old set left more error, and solve for its colours.

    Parameters
    ----------
    gaussians : Gaussians
        The old set, after some steps of a fit. For a batch, the sets of all images.
    objective : Pixels
    count : int
        Number of Gaussians of the new set of each image.
    solve_steps : int, optional
        Steps of the colour solve, see `eigengs_dr.fitting.solve`.

    Returns
    -------
    Gaussians
        The new set. It keeps no Gaussian of the old set.
    """
    images = objective.grid.images
    with dr.suspend_grad():
        owners = Owners.of(gaussians, images)
        error = squared_error(gaussians, objective, owners.lists)

        def density(canvas: Canvas, default: Float, times: int) -> Float:
            if times == 1:
                return target_density(owners, error, default)
            grid = canvas.grid
            scale, inverse = (dr.opaque(canvas.types.Float, v) for v in (times, 1 / times))
            small = replace(
                gaussians,
                mean=gaussians.mean * inverse,
                factor=gaussians.factor * scale,
                width=grid.width,
                height=grid.height,
            )
            less = shrunk(owners.canvas, error, canvas, times)
            return target_density(Owners.of(small, images), less, default)

        placed = place_adaptive(objective, count, gaussians.cutoff, density)
    return solve(placed, objective, solve_steps)

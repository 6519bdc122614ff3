"""Adaptive placement: more and smaller Gaussians where the image has large second derivatives.

Gaussians approximate an image well where it is nearly linear; the error comes from the second
derivatives. So the density of Gaussians follows the squared Hessian
(`eigengs_dr.fitting.placement.filters`). The means are the centroids of pieces of equal mass of a
Hilbert curve, after one Lloyd step (`eigengs_dr.fitting.placement.pieces`). Each Gaussian is
stretched along the direction of the smallest second derivative. The constants were chosen on
training images of faces and of ImageNet classes by the error after 10 steps of the colour solve.

Redistribution places the Gaussians of a fit anew, denser where the fit left more error. At a
density of rho Gaussians per pixel, a fit leaves a squared error of about ``e = k rho^-q`` per
pixel, with q = `ERROR_EXPONENT`. For a given number of
Gaussians, the sum of the errors is smallest if all Gaussians have the same error ``s = e / rho``.
So the density and the error of one fit give the best density:

    rho' ~ k^(1 / (q + 1)) = rho s^(1 / (q + 1)).

Only a fit can tell parts that are hard to fit from parts that merely have large second derivatives.
Neighbouring Gaussians share their errors, see `Owners`; in what a Gaussian owns, the density
follows the second derivatives. The constants were chosen on training images of ImageNet classes and
of cats, by the error after 1,000 steps.

Images are in tile layout, and everything runs on the device. A batch of images takes one launch of
each kernel; no sum of one depends on another.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr

from ...backend.arrays import ArrayTypes, rcp, release_memory, types_of
from ...backend.recording import record
from ...backend.types import Float, Rows
from ...gaussian.file import CUTOFF
from ...gaussian.gaussians import Gaussians, whole
from ...raster.binning.lists import TileLists
from ...raster.binning.tiles import Grid
from ...raster.kernels import forward, sum_by_image, sum_lanes
from ...raster.parameters import detached_shape, gather_run, kernel_radius, pack_parameters
from ...raster.render import bin_gaussians
from ..objective import Pixels, Quadratic
from ..solve import Unknowns, apply, correlate, for_channels, solve, spread
from .filters import PIXELS, Canvas, downsampled, smoothed, squared_hessian
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
        image = downsampled(canvas, image, less, smaller)
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
    energy, trace = squared_hessian(canvas, smoothed(canvas, image, IMAGE_BLUR * spacing), noise)
    trace = smoothed(canvas, trace, DENSITY_BLUR * spacing)
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
    energy = smoothed(canvas, energy, DIRECTION_BLUR * spacing)
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


ERROR_EXPONENT = 4 / 3
"""Exponent q of the decay of the squared error: twice as many Gaussians leave ``2^-q`` of it, which
is 4 dB less, as measured from 1,250 to 20,000 Gaussians on 256x256 pixels."""

MIN_ERROR_SHARE = 1e-3
"""Smallest error of a Gaussian, relative to the average, so that no part of an image is empty."""

NO_ERROR = 1e-12
"""Smallest squared error of a Gaussian: parts without any error keep some Gaussians too."""

NO_WEIGHT = 1e-6
"""Sum of weights that counts as zero: pixels that no Gaussian reaches take the average."""


@dataclass(frozen=True)
class Owners:
    """The parts of pixels that Gaussians own: ``w_n(x) / sum_m w_m(x)`` of the pixel x.

    They overlap, so that what a Gaussian owns is an average over its neighbours too.

    Attributes
    ----------
    canvas : Canvas
    shape : list of Float, shape (N,)
        See `eigengs_dr.raster.parameters.detached_shape`.
    lists : TileLists
    cutoff : float
    total : Float, shape (pixels,)
        ``sum_m w_m(x)`` in tile layout.
    """

    canvas: Canvas
    shape: list
    lists: TileLists
    cutoff: float
    total: Float

    @classmethod
    def of(cls, gaussians: Gaussians, images: int = 1) -> Owners:
        """Return the parts of a set, or of the sets of a batch of images."""
        types, shape = types_of(gaussians.mean), detached_shape(gaussians)
        lists = bin_gaussians(gaussians, images=images)
        total = _sum_weights(shape, types.Float(1), lists, gaussians.cutoff)
        canvas = Canvas(types, lists.grid, lists.sizes)
        return cls(canvas, shape, lists, gaussians.cutoff, total)

    def collect(self, first: Float, second: Float) -> list:
        """Return the sums of two maps (pixels,) over what each Gaussian owns, Floats (N,)."""
        inverse = dr.select(self.total > NO_WEIGHT, rcp(self.total), 0)
        both = dr.empty(type(first), 2 * dr.width(first))
        rows = self.canvas.types.FloatX([first * inverse, second * inverse])
        dr.scatter(both, rows, dr.arange(self.canvas.types.UInt, dr.width(first)))
        dr.eval(both)
        return correlate(self.shape, both, 2, self.lists, self.cutoff)

    def average(self, values: Float) -> Float:
        """Return the average of values (N,) over the owners of each pixel."""
        sums = _sum_weights(self.shape, values, self.lists, self.cutoff)
        _, _, first, _ = self.canvas.pixels()
        image = self.canvas.sizes.image_of(first)
        mean = spread(_mean_by_image(values, self.lists), image)
        return dr.fma(NO_WEIGHT, mean, sums) / (self.total + NO_WEIGHT)


def _sum_weights(shape: list, values: Float, lists: TileLists, cutoff: float) -> Float:
    """Return ``sum_n values_n w_n(x)`` in tile layout; evaluated."""
    packed = pack_parameters([*shape, values])
    image = forward(packed, [type(values)(0)], lists, kernel_radius(cutoff))
    dr.eval(image)
    return image


def _mean_by_image(values: Float, lists: TileLists) -> Float:
    return sum_by_image(values, lists.grid) / (dr.width(values) // lists.grid.images)


@record
def _squares(shape: list, x: Unknowns, model: Quadratic, lists: TileLists, cutoff: float) -> Float:
    """Return ``h (p - t)^2`` of every pixel, added over the channels; evaluated."""
    assert model.target is not None
    types, channels = types_of(model.target), len(x[0])
    error, _ = apply(shape, x, lists, cutoff, Quadratic(model.target))
    dr.eval(error)
    curvature = model.curvatures(lists.grid)
    pixel = dr.arange(types.UInt, lists.grid.tiles * lists.grid.pixels)
    values = dr.width(curvature) // dr.width(pixel)

    def read(image: Float, c: int, number: int) -> Float:
        return dr.gather(types.Float, image, pixel * number + c)

    factors = for_channels([read(curvature, c, values) for c in range(values)], channels)
    squares = sum(f * dr.square(read(error, c, channels)) for c, f in enumerate(factors))
    dr.eval(squares)
    return squares


def error_by_pixel(
    gaussians: Gaussians, objective: Pixels, lists: TileLists | None = None
) -> Float:
    """Return ``sum h (p - t)^2`` over the channels of each pixel for a set.

    Parameters
    ----------
    gaussians : Gaussians
    objective : Pixels
    lists : TileLists, optional
        Lists of the set, if available.

    Returns
    -------
    Float, shape (pixels,)
        In tile layout, 0 outside the image.
    """
    if lists is None:
        lists = bin_gaussians(gaussians, adjoint=False, images=objective.grid.images)
    colors = whole(dr.detach(gaussians.color), gaussians), list(dr.detach(gaussians.background))
    return _squares(detached_shape(gaussians), colors, objective.model, lists, gaussians.cutoff)


def squares_by_channel(gaussians: Gaussians, objective: Pixels) -> list:
    """Return ``sum h (p - t)^2`` over the pixels for each channel, a Float (images,)."""
    lists = bin_gaussians(gaussians, adjoint=False, images=objective.grid.images)
    colors = whole(gaussians.color, gaussians), list(gaussians.background)
    shape, cutoff = detached_shape(gaussians), gaussians.cutoff
    with dr.suspend_grad():
        _, lanes = apply(shape, colors, lists, cutoff, objective.model)
        return sum_lanes(lanes, lists)


def density_ratio(owners: Owners, error: Float, bending: Float) -> Float:
    """Return the ratio of the density for the error to that for the second derivatives.

    For the parameters see `target_density`. Ratios of several parts of an image have one scale:
    together they give a density of the whole image.

    Returns
    -------
    Float, shape (N,)
        The ratio for the part that each old Gaussian owns.
    """
    lists = owners.lists
    share, mass = owners.collect(error, bending)
    dr.eval(share, mass)
    least = dr.maximum(MIN_ERROR_SHARE * _mean_by_image(share, lists), NO_ERROR)
    share = dr.maximum(share, spread(least, lists.image))
    mass = dr.maximum(mass, spread(1e-9 * _mean_by_image(mass, lists), lists.image))
    ratio = dr.exp2(dr.log2(share) / (ERROR_EXPONENT + 1)) / mass
    dr.eval(ratio)
    return ratio


@record
def target_density(owners: Owners, error: Float, bending: Float) -> Float:
    """Return the density at which all Gaussians would have the same error, up to a factor.

    Parameters
    ----------
    owners : Owners
        Parts of the old set.
    error : Float, shape (pixels,)
        Its squared error, in tile layout.
    bending : Float, shape (pixels,)
        Density for the second derivatives of the image, up to a factor.

    Returns
    -------
    Float, shape (pixels,)
        What an old Gaussian with the error s owns gets ``s^(1 / (q + 1))`` Gaussians together, with
        q = `ERROR_EXPONENT`.
    """
    return bending * owners.average(density_ratio(owners, error, bending))


def redistribute(
    gaussians: Gaussians, objective: Pixels, count: int, solve_steps: int = 10, seed: int = 0
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
    seed : int, optional
        See `place_adaptive`.

    Returns
    -------
    Gaussians
        The new set. It keeps no Gaussian of the old set.
    """
    images = objective.grid.images
    with dr.suspend_grad():
        owners = Owners.of(gaussians, images)
        error = error_by_pixel(gaussians, objective, owners.lists)

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
            less = downsampled(owners.canvas, error, canvas, times)
            return target_density(Owners.of(small, images), less, default)

        placed = place_adaptive(objective, count, gaussians.cutoff, density, seed)
    return solve(placed, objective, solve_steps)

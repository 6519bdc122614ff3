"""Redistribution: the Gaussians of a fit are placed anew, denser where the fit left more error.

At a density of rho Gaussians per pixel, a fit leaves a squared error of about ``e = k rho^-q`` per
pixel, with q = `ERROR_EXPONENT`. For a given number of Gaussians, the sum of the errors is smallest
if all Gaussians have the same error ``s = e / rho``. So the density and the error of one fit give
the best density:

    rho' ~ k^(1 / (q + 1)) = rho s^(1 / (q + 1)).

Only a fit can tell parts that are hard to fit from parts that merely have large second derivatives.
Neighbouring Gaussians share their errors, see `Owners`; in what a Gaussian owns, the density
follows the second derivatives. The constants were chosen on training images of ImageNet classes and
of cats, by the error after 1,000 steps.

Images are in tile layout. A batch of images takes one launch of each kernel; no sum of one depends
on another.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr

from ..backend.arrays import rcp, types_of
from ..backend.recording import record
from ..backend.types import Float, Singles
from ..gaussian.gaussians import Gaussians
from ..raster.kernels import image_of, spread, sum_by_image
from ..raster.lists import TileLists
from ..raster.parameters import detached_shape, kernel_radius, pack_parameters
from ..raster.render import bin_gaussians, to_tiles
from .objective import Pixels, Quadratic
from .place import place_adaptive, planes_of, shrunk
from .solve import Unknowns, apply, colors_of, correlate, for_channels, solve

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
    shape : list of Float, shape (N,)
        See `eigengs_dr.raster.parameters.detached_shape`.
    packed : Float
        The Gaussians with one channel, which is 1.
    lists : TileLists
    cutoff : float
    total : Float, shape (pixels,)
        ``sum_m w_m(x)`` in tile layout.
    """

    shape: list
    packed: Float
    lists: TileLists
    cutoff: float
    total: Float

    @classmethod
    def of(cls, gaussians: Gaussians, images: int = 1) -> Owners:
        """Return the parts of a set, or of the sets of a batch of images."""
        types, shape = types_of(gaussians.mean), detached_shape(gaussians)
        lists, cutoff = bin_gaussians(gaussians, images=images), gaussians.cutoff
        packed = pack_parameters([*shape, dr.opaque(types.Float, 1, len(gaussians))])
        return cls(shape, packed, lists, cutoff, _sum_weights(packed, lists, cutoff))

    def collect(self, first: Float, second: Float) -> list:
        """Return the sums of two maps (pixels,) over what each Gaussian owns, Floats (N,)."""
        inverse = dr.select(self.total > NO_WEIGHT, rcp(self.total), 0)
        both = dr.empty(type(first), 2 * dr.width(first))
        types = types_of(first)
        rows = types.FloatX([first * inverse, second * inverse])
        dr.scatter(both, rows, dr.arange(types.UInt, dr.width(first)))
        dr.eval(both)
        # Two channels are packed as one is, in 8 numbers for each Gaussian.
        return correlate(self.packed, both, 2, self.lists, self.cutoff)

    def average(self, values: Float) -> Float:
        """Return the average of values (N,) over the owners of each pixel."""
        packed = pack_parameters([*self.shape, values])
        sums = _sum_weights(packed, self.lists, self.cutoff)
        tile = dr.arange(types_of(values).UInt, dr.width(sums)) // self.lists.grid.pixels
        mean = spread(_mean_by_image(values, self.lists), self.lists.layout.image_of(tile))
        return dr.fma(NO_WEIGHT, mean, sums) / (self.total + NO_WEIGHT)


def _sum_weights(packed: Float, lists: TileLists, cutoff: float) -> Float:
    """Return ``sum_n values_n w_n(x)`` in tile layout, of the packed values; evaluated."""
    return image_of(packed, [type(packed)(0)], lists, kernel_radius(cutoff))


def _mean_by_image(values: Float, lists: TileLists) -> Float:
    return sum_by_image(values, lists.grid) / (dr.width(values) // lists.grid.images)


@record
def _squares(shape: list, x: Unknowns, model: Quadratic, lists: TileLists, cutoff: float) -> Float:
    """Return ``h (p - t)^2`` of every pixel, added over the channels; evaluated."""
    types, channels = types_of(model.target), len(x[0])
    packed = pack_parameters([*shape, *x[0]])
    error, _ = apply(packed, x[1], lists, cutoff, Quadratic(model.target))
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
    shape, colors = detached_shape(gaussians), colors_of(gaussians)
    return _squares(shape, colors, objective.model, lists, gaussians.cutoff)


def squares_by_channel(gaussians: Gaussians, objective: Pixels) -> list:
    """Return ``sum h (p - t)^2`` over the pixels for each channel, a Float (images,)."""
    lists = bin_gaussians(gaussians, adjoint=False, images=objective.grid.images)
    color, background = colors_of(gaussians)
    with dr.suspend_grad():
        packed = pack_parameters([*detached_shape(gaussians), *color])
        return apply(packed, background, lists, gaussians.cutoff, objective.model)[1]


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

        def density(default: Singles, times: int) -> Singles:
            parts, seen = owners, error
            if times > 1:
                scale, inverse = (dr.opaque(type(error), v) for v in (times, 1 / times))
                height, width = default.shape[1:]
                mean, factor = gaussians.mean * inverse, gaussians.factor * scale
                small = replace(gaussians, mean=mean, factor=factor, width=width, height=height)
                parts = Owners.of(small, images)
                less = shrunk(planes_of(error, objective.grid)[:, 0], times)
                seen = to_tiles(objective.types, less[..., None])
            bending = to_tiles(objective.types, default[..., None])
            return planes_of(target_density(parts, seen, bending), parts.lists.grid)[:, 0]

        placed = place_adaptive(objective, count, gaussians.cutoff, density, seed)
    return solve(placed, objective, solve_steps)

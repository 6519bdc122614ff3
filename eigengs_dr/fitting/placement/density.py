"""The density of Gaussians for the error that a fit left."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr

from ...backend.arrays import rcp, types_of
from ...backend.recording import record
from ...backend.types import Float
from ...gaussian.gaussians import Gaussians, whole
from ...raster.binning.lists import TileLists
from ...raster.kernels import forward, sum_by_image, sum_lanes
from ...raster.parameters import detached_shape, kernel_radius, pack_parameters
from ...raster.render import bin_gaussians
from ..objective import Pixels, Quadratic
from ..solve import Unknowns, apply, by_channel, correlate, spread
from .filters import Canvas

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

    factors = by_channel([read(curvature, c, values) for c in range(values)], channels)
    squares = sum(f * dr.square(read(error, c, channels)) for c, f in enumerate(factors))
    dr.eval(squares)
    return squares


def squared_error(gaussians: Gaussians, objective: Pixels, lists: TileLists | None = None) -> Float:
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

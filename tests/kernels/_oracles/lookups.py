"""Lookups of sets at points and over footprints, as textures make them."""

import drjit as dr

from _helpers.footprints import coordinates
from eigengs_dr.backend.arrays import types_of
from eigengs_dr.raster.lookup.cells import list_cells
from eigengs_dr.raster.lookup.points import Packed, invert, sum_at_points, value_terms
from eigengs_dr.raster.lookup.prefilter import sum_prefiltered
from eigengs_dr.raster.lookup.size_classes import classify_by_size
from eigengs_dr.raster.parameters import kernel_radius
from eigengs_dr.raster.render import decode_parameters


def cells_of(gaussians, cutoff=3.0, side=4):
    """Lists of the Gaussians that touch cells."""
    level = dr.detach(decode_parameters(gaussians).shape), side
    return list_cells([level], gaussians.width, gaussians.height, kernel_radius(cutoff))


def sums_at(gaussians, points, cutoff=3.0, side=4, terms=value_terms, number=1):
    """Rows of sums at points, shape (points, 2) or x and y, without the background."""
    p, cells = decode_parameters(gaussians), cells_of(gaussians, cutoff, side)
    packed = Packed(cells.pack(p.shape, p.color), gaussians.channels, cutoff)
    types, count = types_of(gaussians.mean), number * gaussians.channels
    x, y = points if isinstance(points, tuple) else coordinates(types.Float, points)
    return sum_at_points(cells, packed, x, y, types.Bool(True), terms(packed), count)


def classes_of(gaussians, wrap, cutoff):
    """Lists of Gaussians by their size, and their packed parameters."""
    p = decode_parameters(gaussians)
    size = gaussians.width, gaussians.height
    sizes = classify_by_size(dr.detach(p.shape), *size, cutoff, wrap)
    rows = sizes.cells.pack(*invert(p.shape, p.color))
    return sizes, Packed(rows, gaussians.channels, cutoff, inverted=True)


def footprint_of(Float, covariance):
    """Entries of a covariance, which no program knows."""
    return [dr.opaque(Float, float(covariance[k])) for k in ((0, 0), (0, 1), (1, 1))]


def filtered(gaussians, wrap, points, covariance, cutoff):
    """Rows of sums that a footprint sees at points, without the background."""
    types = types_of(gaussians.mean)
    x, y = coordinates(types.Float, points)
    footprint = footprint_of(types.Float, covariance)
    classes = classes_of(gaussians, wrap, cutoff)
    return sum_prefiltered(*classes, x, y, footprint, types.Bool(True))


def squares(rows):
    """The sum of the squares of rows, as a loss."""
    return dr.sum(sum(dr.square(row) for row in rows))

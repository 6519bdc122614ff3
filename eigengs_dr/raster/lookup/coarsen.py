"""Construction of a `eigengs_dr.raster.lookup.pyramid.GaussianPyramid`: its coarser sums."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import drjit as dr

from ...backend.arrays import ArrayTypes, types_of
from ..binning.lists import build_lists
from ..binning.tiles import Grid
from ..evaluate import widen
from ..layout import unpack_parameters
from ..parameters import NUM_SHAPE_PARAMS, KernelParameters, kernel_covariance, kernel_radius
from ..render import rasterize
from ..rows import to_tensor
from .prefilter import sum_prefiltered
from .pyramid import (
    SAMPLE_DEVIATION,
    GaussianPyramid,
    Level,
    count_points,
    sum_pyramid,
)
from .size_classes import FOOTPRINT_REACH, SizeClasses

FINEST, FEWEST = 1, 8
"""Spacing of the points of the finest level, in pixels (the points are the pixels), and smallest
number of points along the shorter side of the coarsest level."""


def build_pyramid(sizes: SizeClasses, packed: Any, number: int, cutoff: float) -> GaussianPyramid:
    """Evaluate a sum of Gaussians at the points of all levels; differentiable.

    Cost: a rendering of the blurred Gaussians for the finest level, and one
    `eigengs_dr.raster.lookup.prefilter.sum_prefiltered` for each of its points at a border. Each
    other level samples the previous level.

    Parameters
    ----------
    sizes, packed, number, cutoff
        As for `eigengs_dr.raster.lookup.prefilter.sum_prefiltered`.

    Returns
    -------
    GaussianPyramid
    """
    types = types_of(packed)
    width, height = sizes.width, sizes.height
    pyramid = GaussianPyramid(width, height, sizes.wrap, number - NUM_SHAPE_PARAMS, (), None)
    parts: list = []
    spacing = FINEST
    while not parts or min(width, height) >= FEWEST * spacing:
        nx, ny = math.ceil(width / spacing), math.ceil(height / spacing)
        level = Level(sum(map(count_points, pyramid.levels)), nx, ny, width / nx, height / ny)
        index = dr.arange(types.UInt, nx * ny)
        x = (types.Float(index % nx) + 0.5) * level.dx
        y = (types.Float(index // nx) + 0.5) * level.dy
        blur = [types.Float((SAMPLE_DEVIATION * level.dx) ** 2), types.Float(0)]
        blur.append(types.Float((SAMPLE_DEVIATION * level.dy) ** 2))
        if parts:
            finer = replace(pyramid, levels=(replace(pyramid.levels[-1], first=0),))
            seen = sum_pyramid(replace(finer, values=parts[-1]), x, y, blur, types.Bool(True))
        else:
            seen = _finest(sizes, packed, number, (x, y), blur, cutoff)
        parts.append(_interleaved(types, seen, nx * ny))
        pyramid = replace(pyramid, levels=(*pyramid.levels, level))
        spacing *= 2
    values = dr.concat(parts)
    dr.eval(values)
    return replace(pyramid, values=values)


def _finest(
    sizes: SizeClasses, packed: Any, number: int, points: tuple, blur: list, cutoff: float
) -> list:
    """Return the blurred sum at all pixels: widen all Gaussians once, and render them.

    At the border, copies of the image and the part of a Gaussian inside the image count too.
    """
    types = types_of(packed)
    width, height = sizes.width, sizes.height
    count = dr.width(packed) // (-(-number // 4) * 4)
    rows = unpack_parameters(packed, dr.arange(types.UInt, count), number)
    shape, amplitude = widen(rows[:NUM_SHAPE_PARAMS], kernel_covariance(blur))
    color = [amplitude * c for c in rows[NUM_SHAPE_PARAMS:]]
    grid, radius = Grid(width, height), kernel_radius(cutoff)
    fixed = [dr.detach(s) + dr.zeros(types.Float, count) for s in shape]
    lists = build_lists(fixed, radius, grid, adjoint=dr.grad_enabled(packed))
    parameters = KernelParameters(shape, color, [types.Float(0) for _ in color])
    image = to_tensor(rasterize(parameters, lists, cutoff), grid, len(color)).array
    x, y = points
    border = math.ceil(FOOTPRINT_REACH * SAMPLE_DEVIATION * FINEST)
    edge = (x < border) | (x > width - border) | (y < border) | (y > height - border)
    ring = dr.compress(edge)
    near = [dr.gather(types.Float, v, ring) for v in points]
    everywhere = types.Bool(True)
    seen = sum_prefiltered(sizes, packed, number, near[0], near[1], blur, everywhere, cutoff)
    dr.eval(seen)  # once for all channels
    index = dr.arange(types.UInt, width * height)
    result = []
    for k, part in enumerate(seen):
        whole = dr.zeros(types.Float, width * height)
        dr.scatter(whole, part, ring)
        inner = dr.gather(types.Float, image, index * len(color) + k)
        result.append(dr.select(edge, whole, inner))
    return result


def _interleaved(types: ArrayTypes, rows: list, count: int) -> Any:
    """Store the values of all channels point after point, 4 numbers per point."""
    padded = [*rows, *[types.Float(0)] * (4 - len(rows))]
    flat = dr.ravel(types.FloatX([row + dr.zeros(types.Float, count) for row in padded]), order="F")
    dr.eval(flat)
    return flat

"""Lookups of ``gaussian_texture`` that average over the footprint of a pixel."""

from __future__ import annotations

from typing import Any

import drjit as dr

from eigengs_dr.raster.lookup.footprint import bound_covariance
from eigengs_dr.raster.lookup.prefilter import sum_prefiltered
from eigengs_dr.raster.lookup.pyramid import is_minified, sum_pyramid
from eigengs_dr.raster.parameters import NUM_SHAPE_PARAMS

from .cone import seen_metric

INSIDE = 0.01
"""Distance in pixels of clamped points from the border."""


def sum_over_footprint(texture: Any, si: Any, column: tuple, row: tuple, active: Any) -> list:
    """Average the sum of Gaussians over the footprint around a point.

    Parameters
    ----------
    texture : mitsuba.Texture
        A ``gaussian_texture`` with a prefilter.
    si : mitsuba.SurfaceInteraction3f
    column, row : tuple of 2 Float
        x and y in pixels, with their slopes, from `eigengs_dr.raster.lookup.points.fold`.
    active : Bool

    Returns
    -------
    list of Float
        One sum for each channel, without the background.
    """
    # The slopes of `fold` turn a footprint in mirrored images. They also take away its width along
    # an axis on which the point lies outside of a clamped image.
    (x, sx), (y, sy) = column, row
    sx, sy = sx * texture.width, sy * texture.height
    if texture.wrap == "clamp":  # a footprint without width would count half on a border
        x = dr.clip(x, INSIDE, texture.width - INSIDE)
        y = dr.clip(y, INSIDE, texture.height - INSIDE)
    inverse, valid = seen_metric(si, texture.transform.inverse, texture.angle)
    unit, blind = bound_covariance(inverse)
    sizes = (sx * sx, sx * sy, sy * sy)
    footprint = [dr.select(valid, f * s, 0) for f, s in zip(unit, sizes, strict=True)]
    blind &= valid & (sx * sy != 0)
    distant = is_minified(texture.pyramid, footprint)
    near = sum_prefiltered(
        texture.sizes,
        texture.packed,
        NUM_SHAPE_PARAMS + texture.channels,
        x,
        y,
        footprint,
        active & ~distant,
        texture.cutoff,
    )
    far = sum_pyramid(texture.pyramid, x, y, footprint, active & distant & ~blind)
    seen = [dr.select(distant, f, n) for f, n in zip(far, near, strict=True)]
    return [dr.select(blind, m, s) for m, s in zip(texture.average, seen, strict=True)]

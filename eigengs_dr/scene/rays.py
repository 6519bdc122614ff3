"""The rays of a camera to a texture: where they hit it, and how large a pixel is there.

Rays go through every pixel to their first hit. If they hit the texture, the ray differentials give
the parallelogram ``J`` that the pixel covers there, in texels. Rays do not follow mirrors or glass,
and the lens is a pinhole.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import upload
from ..raster.lookup.points import fold

SPACING = 0.5
"""Largest distance of neighbouring rays in texels, so that rays hit each texel."""

MIN_RAYS = 2
"""Smallest number of rays along a side of a pixel, because borders of the texture cross pixels."""

MAX_RAYS = 1 << 22
"""Largest number of rays of a camera. If they miss a texel, the nearest hit counts for it."""

BATCH = 1 << 20
"""Number of rays that are traced at once."""

Floats = NDArray[np.floating]


class View(NamedTuple):
    """A camera, the shapes with the texture, and the map from their uv to texels."""

    scene: Any
    sensor: Any
    shapes: list
    to_uv: NDArray[np.float64]
    wrap: str
    width: int
    height: int


class Hits(NamedTuple):
    """Rays that hit the texture: pixel, position and half axes of the pixel there, in texels.

    The half axes are the singular values of J; `side` counts the rays along a side of a pixel.
    """

    pixel: NDArray[Any]
    x: Floats
    y: Floats
    short: Floats
    long: Floats
    side: int


def trace_samples(view: View) -> Hits | None:
    """Trace rays at a distance of `SPACING` texels; None if the camera does not see the texture."""
    columns, rows = view.sensor.film().crop_size()
    every = np.arange(columns * rows, dtype=np.uint32)
    hits = _trace(view, every, MIN_RAYS)
    if not hits.pixel.size:
        return None
    pixels = np.unique(hits.pixel)
    needed = math.ceil(min(float(hits.long.max()) / SPACING, MAX_RAYS))
    side = min(needed, math.isqrt(MAX_RAYS // len(pixels)))
    return _trace(view, pixels, side) if side > MIN_RAYS else hits


def _trace(view: View, pixels: NDArray[np.uint32], side: int) -> Hits:
    """Trace ``side * side`` rays through each pixel, and keep the rays that hit the texture."""
    step = max(1, BATCH // side**2)
    parts = []
    for first in range(0, len(pixels), step):
        pixel, where = _film_positions(view.sensor, pixels[first : first + step], side)
        hit, *values = _trace_to(view, where)
        chosen = np.flatnonzero(hit.numpy())
        parts.append([array.numpy()[chosen] for array in (pixel, *values)])
    pixel, x, y, short, long = (np.concatenate(c) for c in zip(*parts, strict=True))
    return Hits(pixel, x, y, short, long, side)


def _film_positions(sensor: Any, pixels: NDArray[np.uint32], side: int) -> tuple[Any, Any]:
    """Return the pixel of every ray, and its position on the film, in [0, 1]."""
    columns, rows = sensor.film().crop_size()
    ray = dr.arange(mi.UInt32, len(pixels) * side * side)
    across = dr.opaque(mi.UInt32, side)  # one program for every number of rays
    pixel = dr.gather(mi.UInt32, upload(mi.UInt32, pixels), ray // (across * across))
    inside = ray % (across * across)
    x = pixel % columns + (mi.Float(inside % across) + 0.5) / across
    y = pixel // columns + (mi.Float(inside // across) + 0.5) / across
    return pixel, mi.Point2f(x / columns, y / rows)


def _trace_to(view: View, where: Any) -> tuple:
    """Trace rays from positions on the film: return their hits, positions and half axes."""
    with dr.suspend_grad():
        ray, _ = view.sensor.sample_ray_differential(0.0, 0.5, where, mi.Point2f(0.5))
        ray.has_differentials = True  # a batch of sensors computes them but leaves this False
        si = view.scene.ray_intersect(ray, mi.RayFlags.All, True)
        si.compute_uv_partials(ray)
        hit = mi.Bool(False)
        for shape in view.shapes:
            hit |= si.shape == mi.ShapePtr(shape)
        values = _on_texture(si, view)
        hit &= si.is_valid() & dr.isfinite(values[-1]) & (values[-1] > 0)
        dr.eval(hit, values)
        return hit, *values


def _on_texture(si: Any, view: View) -> tuple:
    """Return the position (x, y) of a hit and the singular values of J, all in texels."""
    to_x, to_y = (view.to_uv * [[view.width], [view.height]]).tolist()

    def along(row: list[float], uv: Any) -> Any:
        return row[0] * uv.x + row[1] * uv.y

    x, _ = fold(along(to_x, si.uv) + to_x[2], view.width, view.wrap)
    y, _ = fold(along(to_y, si.uv) + to_y[2], view.height, view.wrap)
    ux, uy = along(to_x, si.duv_dx), along(to_x, si.duv_dy)
    vx, vy = along(to_y, si.duv_dx), along(to_y, si.duv_dy)
    # Eigenvalues of J J^T; the determinant gives the smaller one, as a difference would cancel.
    xx, xy, yy = ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy
    half = 0.5 * (xx - yy)
    long = dr.sqrt(0.5 * (xx + yy) + dr.sqrt(half * half + xy * xy))
    return x, y, dr.abs(ux * vy - uy * vx) / long, long

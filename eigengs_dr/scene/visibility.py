"""What the cameras of a Mitsuba scene resolve of a texture: footprints, lookups, what is unseen.

Rays go through every pixel of every camera to what they hit first. Where that is the texture, the
pixel's differentials give the parallelogram ``J`` that it covers there, in texels, and with it the
footprint ``PIXEL^2 J J^T`` of the texture's own prefilter (`eigengs_dr.plugins.cone`). Of a texel
the sharpest look counts. What mirrors or glass show is not followed, and the lens is a pinhole.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..plugins.cone import PIXEL  # first, for it says what to install where Mitsuba is missing

# isort: split
import drjit as dr
import mitsuba as mi
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array

from ..backend.arrays import upload
from ..raster.lookup.points import fold

SPACING = 0.5
"""Texels between two rays that are close enough: each texel is then met by some."""

MIN_RAYS = 2
"""Rays along a side of a pixel, at least: borders of the texture cross pixels."""

MAX_RAYS = 1 << 22
"""Rays of a camera; where these are too few, texels between hits take after the nearest one."""

BATCH = 1 << 20
"""Rays that are traced at once."""

PIXEL_REACH = 0.75
"""Distances of neighbouring rays over which a hit speaks for texels: half a diagonal, and some."""

NEIGHBOURS = 1.5
"""Texels that are added to that: bilinear lookups read the next ones, also across a corner."""

WRAPS = ("repeat", "mirror", "clamp")
"""What lies outside of the image."""

Floats = NDArray[np.floating]


class Visibility(NamedTuple):
    """What cameras see of a texture.

    Attributes
    ----------
    footprint : ndarray of float32, shape (H, W)
        Standard deviation of the footprint of a pixel, in texels, by the camera and pixel that see
        a texel most sharply; infinite where none does. A footprint that is longer than wide counts
        as if it were round and as small as it is narrow: no detail is taken for lost that is seen
        along some direction.
    pixel_to_texel : list of scipy.sparse.csr_array of float32, shape (pixels, H * W)
        For each camera that sees the texture, of each pixel that does, the share of every texel in
        what it sees of the texture: rows add up to 1. ``lookups[k] @ texels`` is the texture in
        even light.
    """

    footprint: NDArray[np.float32]
    pixel_to_texel: list[Any]

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Whether some pixel sees a texel, shape (H, W)."""
        return np.isfinite(self.footprint)

    @property
    def pixels(self) -> NDArray[np.float32]:
        """Share of each texel in what a camera sees, shape (H, W); mean of cameras, sum 1."""
        shares = [np.asarray(rows.sum(axis=0)) / rows.shape[0] for rows in self.pixel_to_texel]
        return np.mean(shares, axis=0, dtype=np.float32).reshape(self.footprint.shape)


def visibility(
    scene: Any, texture: str, width: int, height: int, wrap_mode: str = "repeat"
) -> Visibility:
    """Measure what the cameras of a scene resolve of a texture.

    Parameters
    ----------
    scene : mitsuba.Scene
        All its sensors count, each with the size and crop of its film.
    texture : str
        Name of the texture among the parameters of the scene (`mitsuba.traverse`), such as
        ``"poster.bsdf.reflectance"``: a bitmap or a ``gaussian_texture`` of any content.
    width, height : int
        Texels to measure on: the size of the image that the texture shall show.
    wrap_mode : {"repeat", "mirror", "clamp"}, optional
        That of a bitmap, which does not tell it; a ``gaussian_texture`` does.

    Returns
    -------
    Resolution

    Raises
    ------
    ValueError
        If there is no such texture, the wrap mode is unknown, or no pixel sees the texture.
    """
    if wrap_mode not in WRAPS:
        raise ValueError(f"wrap_mode {wrap_mode!r} is unknown; use one of {', '.join(WRAPS)}")
    node, shapes = _find(scene, texture)
    to_uv, wrap = _mapping(node, wrap_mode)
    footprint = np.full(height * width, np.inf, np.float32)
    lookups = []
    for sensor in scene.sensors():
        hits = _samples_of(_View(scene, sensor, shapes, to_uv, wrap, width, height))
        if hits is None:
            continue
        np.minimum(footprint, _min_footprint(hits, width, height), out=footprint)
        lookups.append(_rows(hits, width, height))
    if not lookups:
        raise ValueError(
            f"no pixel of the scene's {len(scene.sensors())} cameras sees {texture!r}; check where "
            "they look, and what stands in front"
        )
    return Visibility(footprint.reshape(height, width), lookups)


# --- The texture in its scene --------------------------------------------------------------------


def _find(scene: Any, texture: str) -> tuple[Any, list]:
    """Find the texture of a name, and the shapes that use it.

    Raises
    ------
    ValueError
        If there is none of that name, or no shape uses it.
    """
    entries = mi.traverse(scene).properties
    textures = {
        key.rpartition(".")[0]: entry[2]
        for key, entry in entries.items()
        if isinstance(entry[2], mi.Texture)
    }
    if texture not in textures:
        known = ", ".join(name for name, t in textures.items() if t.is_spatially_varying())
        raise ValueError(f"texture {texture!r} is not in the scene; it has {known or 'none'}")
    node = textures[texture]
    shapes = [shape for shape in scene.shapes() if node in mi.traverse(shape).hierarchy]
    if not shapes:
        raise ValueError(f"texture {texture!r} belongs to no shape; cameras see shapes alone")
    return node, shapes


def _mapping(node: Any, wrap_mode: str) -> tuple[NDArray[np.float64], str]:
    """Rows of ``to_uv``, shape (2, 3), and the wrap mode of a texture."""
    if hasattr(node, "wrap"):
        return np.array(node.to_uv), node.wrap
    parameters = mi.traverse(node)
    if "to_uv" not in parameters:
        return np.eye(2, 3), wrap_mode
    return np.array(parameters["to_uv"].matrix, np.float64)[:2, [0, 1, -1]], wrap_mode


# --- Rays ----------------------------------------------------------------------------------------


class _View(NamedTuple):
    """A camera, and what it looks for: shapes, and how their uv become texels."""

    scene: Any
    sensor: Any
    shapes: list
    to_uv: NDArray[np.float64]
    wrap: str
    width: int
    height: int


class _Hits(NamedTuple):
    """Rays that meet the texture: pixel, place and half axes of the pixel there, in texels.

    The half axes are the singular values of J; `side` is the rays along a side of a pixel.
    """

    pixel: NDArray[Any]
    x: Floats
    y: Floats
    short: Floats
    long: Floats
    side: int


def _samples_of(view: _View) -> _Hits | None:
    """Send rays close enough to each other; None where a camera does not see the texture."""
    columns, rows = view.sensor.film().crop_size()
    every = np.arange(columns * rows, dtype=np.uint32)
    hits = _trace(view, every, MIN_RAYS)
    if not hits.pixel.size:
        return None
    pixels = np.unique(hits.pixel)
    needed = math.ceil(min(float(hits.long.max()) / SPACING, MAX_RAYS))
    side = min(needed, math.isqrt(MAX_RAYS // len(pixels)))
    return _trace(view, pixels, side) if side > MIN_RAYS else hits


def _trace(view: _View, pixels: NDArray[np.uint32], side: int) -> _Hits:
    """Send ``side * side`` rays through each of the pixels, and keep those that hit the texture."""
    step = max(1, BATCH // side**2)
    parts = []
    for first in range(0, len(pixels), step):
        pixel, where = _film_positions(view.sensor, pixels[first : first + step], side)
        hit, *values = _trace_to(view, where)
        chosen = np.flatnonzero(hit.numpy())
        parts.append([array.numpy()[chosen] for array in (pixel, *values)])
    pixel, x, y, short, long = (np.concatenate(c) for c in zip(*parts, strict=True))
    return _Hits(pixel, x, y, short, long, side)


def _film_positions(sensor: Any, pixels: NDArray[np.uint32], side: int) -> tuple[Any, Any]:
    """Pixel of every ray, and its place on the film, in [0, 1]."""
    columns, rows = sensor.film().crop_size()
    ray = dr.arange(mi.UInt32, len(pixels) * side * side)
    across = dr.opaque(mi.UInt32, side)  # one program for every number of rays
    pixel = dr.gather(mi.UInt32, upload(mi.UInt32, pixels), ray // (across * across))
    inside = ray % (across * across)
    x = pixel % columns + (mi.Float(inside % across) + 0.5) / across
    y = pixel // columns + (mi.Float(inside // across) + 0.5) / across
    return pixel, mi.Point2f(x / columns, y / rows)


def _trace_to(view: _View, where: Any) -> tuple:
    """Trace rays from places on the film: which hit, where, and the half axes of their pixels."""
    with dr.suspend_grad():
        ray, _ = view.sensor.sample_ray_differential(0.0, 0.5, where, mi.Point2f(0.5))
        ray.has_differentials = True  # a batch of sensors computes them, and does not say so
        si = view.scene.ray_intersect(ray, mi.RayFlags.All, True)
        si.compute_uv_partials(ray)
        hit = mi.Bool(False)
        for shape in view.shapes:
            hit |= si.shape == mi.ShapePtr(shape)
        values = _on_texture(si, view)
        hit &= si.is_valid() & dr.isfinite(values[-1]) & (values[-1] > 0)
        dr.eval(hit, values)
        return hit, *values


def _on_texture(si: Any, view: _View) -> tuple:
    """Place of a hit, x and y, and the singular values of the pixel's J, all in texels."""
    to_x, to_y = (view.to_uv * [[view.width], [view.height]]).tolist()

    def along(row: list[float], uv: Any) -> Any:
        return row[0] * uv.x + row[1] * uv.y

    x, _ = fold(along(to_x, si.uv) + to_x[2], view.width, view.wrap)
    y, _ = fold(along(to_y, si.uv) + to_y[2], view.height, view.wrap)
    ux, uy = along(to_x, si.duv_dx), along(to_x, si.duv_dy)
    vx, vy = along(to_y, si.duv_dx), along(to_y, si.duv_dy)
    # Eigenvalues of J J^T, the smaller one by the determinant: a difference would cancel.
    xx, xy, yy = ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy
    half = 0.5 * (xx - yy)
    long = dr.sqrt(0.5 * (xx + yy) + dr.sqrt(half * half + xy * xy))
    return x, y, dr.abs(ux * vy - uy * vx) / long, long


# --- Maps ----------------------------------------------------------------------------------------


def _min_footprint(hits: _Hits, width: int, height: int) -> NDArray[np.float32]:
    """Smallest footprint at every texel, shape (H * W,); infinite where no hit is near."""
    column = hits.x.astype(int).clip(0, width - 1)
    texel = hits.y.astype(int).clip(0, height - 1) * width + column
    footprint = np.full(height * width, np.inf, np.float32)
    np.minimum.at(footprint, texel, (PIXEL * hits.short).astype(np.float32))
    reach = np.zeros(height * width, np.float32)
    np.maximum.at(
        reach, texel, (PIXEL_REACH * hits.long / hits.side + NEIGHBOURS).astype(np.float32)
    )
    away, (row, column) = distance_transform_edt(
        np.isinf(footprint).reshape(height, width), return_indices=True
    )
    nearest = (row * width + column).ravel()
    return np.where(away.ravel() <= reach[nearest], footprint[nearest], np.float32(np.inf))


def _rows(hits: _Hits, width: int, height: int) -> Any:
    """Shares of texels in pixels, bilinear at every hit; see `Visibility.pixel_to_texel`."""
    pixels, row, count = np.unique(hits.pixel, return_inverse=True, return_counts=True)
    left, top = np.floor(hits.x - 0.5), np.floor(hits.y - 0.5)
    across, down = hits.x - 0.5 - left, hits.y - 0.5 - top
    result = 0
    for dx, wx in ((0, 1 - across), (1, across)):
        for dy, wy in ((0, 1 - down), (1, down)):
            column = (left + dx).astype(int).clip(0, width - 1)
            texel = (top + dy).astype(int).clip(0, height - 1) * width + column
            share = (wx * wy / count[row]).astype(np.float32)
            shape = (len(pixels), height * width)
            result = result + coo_array((share, (row, texel)), shape=shape).tocsr()
    return result

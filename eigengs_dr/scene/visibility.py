"""Visibility: the texels of a texture that the cameras of a Mitsuba scene see, and how sharply.

Rays go through every pixel of every camera to their first hit. Where they hit the texture, rays
through other points of the pixel give the parallelogram ``J`` that the pixel covers there, in
texels, and with it the footprint ``PIXEL^2 J J^T`` of the prefilter (`eigengs_dr.plugins.cone`).
The smallest footprint of a texel counts. Rays go on through holes of masks, but do not follow
mirrors or glass, and the lens is a pinhole. A lamp is seen by what it lights too, coarsely.

Mitsuba's ray differentials and footprints would give J too, but versions differ in them, and
footprints end at the first surface.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array, csr_array

from ..backend.arrays import upload
from ..backend.types import Float, Floats, Texture
from ..plugins.cone import PIXEL
from ..plugins.properties import WRAPS, to_uv
from ..raster.lookup.points import fold

SPACING = 0.5
"""Largest distance of neighbouring rays in texels, so that rays hit each texel."""

MIN_RAYS = 2
"""Smallest number of rays along a side of a pixel, because borders of the texture cross pixels."""

MAX_RAYS = 1 << 22
"""Largest number of rays of a camera. If they miss a texel, the nearest hit counts for it."""

BATCH = 1 << 20
"""Number of rays that are traced at once."""

MAX_LAYERS = 16
"""Largest number of surfaces along a ray, all but the last with holes."""

LAMP_BLOCKS = 16
"""Number of blocks along a side of a lamp. Their means count like what a pixel sees."""


class View(NamedTuple):
    """A camera, the shapes with the texture, and the map from their uv to texels."""

    scene: mi.Scene
    sensor: mi.Sensor
    shapes: list
    to_texels: mi.ScalarTransform3f
    wrap: str
    size: tuple[int, int]


class Hits(NamedTuple):
    """Rays that hit the texture: pixel, position and half axes of the pixel there, in texels.

    The half axes are the singular values of J; `side` counts the rays along a side of a pixel.
    """

    pixel: NDArray[np.uint32]
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
        for hit, *values in _trace_batch(view, pixels[first : first + step], side):
            chosen = np.flatnonzero(hit.numpy())
            parts.append([array.numpy()[chosen] for array in values])
    pixel, x, y, short, long = (np.concatenate(c) for c in zip(*parts, strict=True))
    return Hits(pixel, x, y, short, long, side)


def _trace_batch(view: View, pixels: NDArray[np.uint32], side: int) -> Iterator[tuple]:
    """Trace ``side * side`` rays through each pixel: yield hit or not, and arrays of `Hits`.

    Rays that meet a hole of a mask go on behind it, for the next layer.
    """
    columns, _ = view.sensor.film().crop_size()
    ray = dr.arange(mi.UInt32, len(pixels) * side * side)
    across = dr.opaque(mi.UInt32, side)  # one program for every number of rays
    pixel = dr.gather(mi.UInt32, upload(mi.UInt32, pixels), ray // (across * across))
    inside = ray % (across * across)
    place = (mi.Point2f(inside % across, inside // across) + 0.5) / mi.Float(across)
    corner = mi.Point2f(pixel % columns, pixel // columns)
    with dr.suspend_grad():
        ray, others = _rays(view, corner, place)
        has_holes = any(
            mi.has_flag(s.bsdf().flags(), mi.BSDFFlags.Null) for s in view.scene.shapes()
        )
        onward, active = ray, mi.Bool(True)
        for _ in range(MAX_LAYERS if has_holes else 1):
            si = view.scene.ray_intersect(onward, active)
            hit = mi.Bool(False)
            for shape in view.shapes:
                hit |= si.shape == mi.ShapePtr(shape)
            partials = [_uv_at(si, other) / step for other, step in others]
            x, y, short, long = _on_texture(si, partials, view)
            hit &= si.is_valid() & dr.isfinite(long) & (long > 0)
            dr.eval(hit, x, y, short, long)
            yield hit, pixel, x, y, short, long
            if has_holes:
                active &= si.is_valid()
                passed = mi.unpolarized_spectrum(si.bsdf().eval_null_transmission(si, active))
                active &= dr.any(passed > 0)
                if not dr.any(active):
                    return
                onward = si.spawn_ray(ray.d)


def _rays(
    view: View, corner: mi.Point2f, place: mi.Point2f
) -> tuple[mi.Ray3f, list[tuple[mi.Ray3f, Float]]]:
    """Return rays through places in pixels, and two others with their steps to the right and down.

    They are half a pixel away, towards its middle: in a batch of cameras, the next pixel may be
    that of another camera.
    """

    def through(place: mi.Point2f) -> mi.Ray3f:
        film = (corner + place) / mi.Point2f(view.sensor.film().crop_size())
        return view.sensor.sample_ray(0.0, 0.5, film, mi.Point2f(0.5))[0]

    x, y = (dr.select(p < 0.5, mi.Float(0.5), mi.Float(-0.5)) for p in place)
    right, down = through(place + mi.Vector2f(x, 0)), through(place + mi.Vector2f(0, y))
    return through(place), [(right, x), (down, y)]


def _uv_at(si: mi.SurfaceInteraction3f, ray: mi.Ray3f) -> mi.Vector2f:
    """Return the step in uv from a hit to where another ray meets its tangent plane.

    The step p in space is ``dp_du u + dp_dv v``, which two equations of the least squares solve.
    """
    t = dr.dot(si.n, si.p - ray.o) / dr.dot(si.n, ray.d)
    step = ray(t) - si.p
    uu, uv, vv = (
        dr.dot(a, b) for a, b in ((si.dp_du, si.dp_du), (si.dp_du, si.dp_dv), (si.dp_dv, si.dp_dv))
    )
    u, v = dr.dot(si.dp_du, step), dr.dot(si.dp_dv, step)
    return mi.Vector2f(vv * u - uv * v, uu * v - uv * u) / (uu * vv - uv * uv)


def _on_texture(
    si: mi.SurfaceInteraction3f, partials: list[mi.Vector2f], view: View
) -> tuple[Float, Float, Float, Float]:
    """Return the position (x, y) of a hit and the singular values of J, all in texels."""
    at = view.to_texels @ si.uv
    right, down = (view.to_texels @ d for d in partials)
    (x, _), (y, _) = (fold(v, side, view.wrap) for v, side in zip(at, view.size, strict=True))
    # Eigenvalues of J J^T; the determinant gives the smaller one, as a difference would cancel.
    xx, yy = right.x * right.x + down.x * down.x, right.y * right.y + down.y * down.y
    xy, half = right.x * right.y + down.x * down.y, 0.5 * (xx - yy)
    long = dr.sqrt(0.5 * (xx + yy) + dr.sqrt(half * half + xy * xy))
    return x, y, dr.abs(right.x * down.y - down.x * right.y) / long, long


PIXEL_REACH = 0.75
"""Radius around a hit in which texels count as seen, in distances of neighbouring rays: a bit more
than half a diagonal."""

NEIGHBOURS = 1.5
"""Texels added to this radius, because bilinear lookups read neighbours, also diagonal ones."""


class Box(NamedTuple):
    """A part of an image, in texels."""

    left: int
    top: int
    width: int
    height: int

    def of(self, image: NDArray[Any]) -> NDArray[Any]:
        """Return the part of an image, shape (H, W, ...)."""
        return image[self.top : self.top + self.height, self.left : self.left + self.width]


class Visibility(NamedTuple):
    """What cameras see of a texture.

    Attributes
    ----------
    footprint : ndarray of float32, shape (H, W)
        Smallest standard deviation, in texels, of a pixel's footprint at each texel; infinite at
        unseen texels. The shorter axis counts, so that no detail visible along one axis is lost.
    pixel_to_texel : list of scipy.sparse.csr_array of float32, shape (pixels, H * W)
        One matrix for each camera that sees the texture, and for each use of it, with one row for
        each pixel that sees it: the shares of the texels in the pixel, with the sum 1. Before them,
        for a lamp, one with a row for each of its blocks.
        ``pixel_to_texel[k] @ texels`` is the view of camera k in even light.
    """

    footprint: NDArray[np.float32]
    pixel_to_texel: list[csr_array]

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Whether a pixel sees each texel: ndarray of bool, shape (H, W)."""
        return np.isfinite(self.footprint)

    @property
    def pixels(self) -> NDArray[np.float32]:
        """Mean share of each texel in the views of the cameras, shape (H, W), with the sum 1."""
        shares = [np.asarray(rows.sum(axis=0)) / rows.shape[0] for rows in self.pixel_to_texel]
        return np.mean(shares, axis=0, dtype=np.float32).reshape(self.footprint.shape)


def visibility(
    scene: mi.Scene,
    texture: str | Texture | Sequence[str | Texture],
    width: int,
    height: int,
    wrap_mode: str | Sequence[str] = "repeat",
    part: Box | None = None,
) -> Visibility:
    """Measure what the cameras of a scene resolve of a texture.

    Parameters
    ----------
    scene : mitsuba.Scene
        All its sensors count, with the size and crop of their films.
    texture : str, mitsuba.Texture, or a sequence of them
        Name of the texture among the parameters of the scene (`mitsuba.traverse`), such as
        ``"poster.bsdf.reflectance"``: a bitmap or a ``gaussian_texture`` of any content. Several
        textures count as uses of one image.
    width, height : int
        Size in texels: that of the image for the texture.
    wrap_mode : {"repeat", "mirror", "clamp"}, or a sequence of them, optional
        Wrap mode of each bitmap, which Mitsuba does not expose; a ``gaussian_texture`` has its own.
    part : Box, optional
        The part of the image that is measured, by default all of it. Nothing else may be seen.

    Returns
    -------
    Visibility

    Raises
    ------
    ValueError
        If the scene has no such texture, no shape uses it, no pixel sees it, or the wrap mode is
        unknown.
    """
    textures = list(texture) if isinstance(texture, list | tuple) else [texture]
    wraps = [wrap_mode] * len(textures) if isinstance(wrap_mode, str) else list(wrap_mode)
    for mode in wraps:
        if mode not in WRAPS:
            raise ValueError(f"wrap_mode {mode!r} is unknown; use one of {', '.join(WRAPS)}")
    uses, is_lamp = [], False
    for name, mode in zip(textures, wraps, strict=True):
        node, shapes = _find(scene, name)
        scaled = mi.ScalarTransform3f().scale([width, height]) @ to_uv(mi.traverse(node))
        uses.append((shapes, mi.Transform3f(scaled), getattr(node, "wrap", mode)))
        emitters = (shape.emitter() for shape in shapes)
        is_lamp |= any(e is not None and node in mi.traverse(e).hierarchy for e in emitters)
    size, part = (width, height), part or Box(0, 0, width, height)
    lookups = [_blocks(width, height)] if is_lamp else []
    coarsest = PIXEL * max(width, height) / LAMP_BLOCKS if is_lamp else np.inf
    footprint = np.full(part.height * part.width, coarsest, np.float32)
    for sensor, (shapes, to_texels, wrap) in product(scene.sensors(), uses):
        hits = trace_samples(View(scene, sensor, shapes, to_texels, wrap, size))
        if hits is None:
            continue
        hits = hits._replace(x=hits.x - part.left, y=hits.y - part.top)
        np.minimum(footprint, _min_footprint(hits, part.width, part.height), out=footprint)
        lookups.append(_rows(hits, part.width, part.height))
    if not lookups:
        raise ValueError(
            f"no pixel of the scene's {len(scene.sensors())} cameras sees {_name(texture)}; check "
            "where the cameras look, and what hides the texture"
        )
    return Visibility(footprint.reshape(part.height, part.width), lookups)


# --- The texture in its scene --------------------------------------------------------------------


def _name(texture: object) -> str:
    return repr(texture) if isinstance(texture, str) else "the texture"


def _find(scene: mi.Scene, texture: str | Texture) -> tuple[Texture, list]:
    """Find a texture by its name, and the shapes that use it.

    Raises
    ------
    ValueError
        If the scene has no texture of this name, or no shape uses it.
    """
    node = texture
    if isinstance(texture, str):
        entries = mi.traverse(scene).properties.items()
        nodes = {key.rpartition(".")[0]: entry[2] for key, entry in entries}
        nodes = {key: n for key, n in nodes.items() if isinstance(n, mi.Texture)}
        if texture not in nodes:
            textures = ", ".join(name for name, t in nodes.items() if t.is_spatially_varying())
            raise ValueError(
                f"texture {texture!r} is not in the scene; it has {textures or 'none'}"
            )
        node = nodes[texture]
    shapes = [shape for shape in scene.shapes() if node in mi.traverse(shape).hierarchy]
    if not shapes:
        raise ValueError(f"{_name(texture)} belongs to no shape; name the texture of a shape")
    return node, shapes


# --- Maps ----------------------------------------------------------------------------------------


def _min_footprint(hits: Hits, width: int, height: int) -> NDArray[np.float32]:
    """Return the smallest footprint at every texel, shape (H * W,); infinite far from hits."""
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


def _rows(hits: Hits, width: int, height: int) -> csr_array:
    """Return the bilinear shares of texels in pixels; see `Visibility.pixel_to_texel`."""
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


def _blocks(width: int, height: int) -> csr_array:
    """Return the shares of texels in `LAMP_BLOCKS` x `LAMP_BLOCKS` blocks, as rows of pixels."""
    across, down = min(LAMP_BLOCKS, width), min(LAMP_BLOCKS, height)
    column, row = np.arange(width) * across // width, np.arange(height) * down // height
    block = (row[:, None] * across + column).ravel()
    share = (1 / np.bincount(block)[block]).astype(np.float32)
    shape = (across * down, height * width)
    return coo_array((share, (block, np.arange(height * width))), shape=shape).tocsr()

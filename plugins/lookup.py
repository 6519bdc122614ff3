"""Lookups of ``gaussian_texture``: the sum of Gaussians at a point, or over a footprint.

Values come from parameters in the order of the lists, and derivatives from the parameters
themselves: reading copies is faster, but adding to copies is slower. Dr.Jit leaves the values of
the second sum out, because nobody needs them.

A material that asks twice for the colour of a point pays once. A BSDF looks its textures up in its
evaluation and again in its sampling, often in one recorded program. Dr.Jit merges equal gathers of
a bitmap, but not equal loops.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from eigengs_dr.backend.arrays import Bool, Float
from eigengs_dr.raster.lookup.footprint import bound_covariance
from eigengs_dr.raster.lookup.points import sum_at_points, value_terms
from eigengs_dr.raster.lookup.prefilter import sum_prefiltered, where_any
from eigengs_dr.raster.lookup.pyramid import is_minified, sum_pyramid
from eigengs_dr.raster.parameters import NUM_SHAPE_PARAMS, kernel_radius

from .cone import seen_metric
from .versions import Interaction, Texture


class _Lookups(threading.local):
    """The lookups of this thread since its last change of scope, by what they depend on.

    Dr.Jit starts another scope with every nested call, loop and branch. A result may be used again
    only if there was none since, but for the loops of the lookups themselves: else it could belong
    to a branch that has ended.
    """

    def __init__(self) -> None:
        self.scope = -1
        self.found: dict[tuple, tuple[Any, Any]] = {}


_lookups = _Lookups()


def reused(texture: Texture, si: Interaction, inputs: tuple, look_up: Callable[[], list]) -> list:
    """Return the result of a lookup, from an earlier one with the same inputs if there is one.

    Parameters
    ----------
    texture : mitsuba.Texture
    si : mitsuba.SurfaceInteraction3f
    inputs : tuple of str
        Attributes of `si` on which the lookup depends.
    look_up : callable
        Makes the result, for all lanes of the program: of two callers, one may need other lanes.

    Returns
    -------
    list of Float
        Never shared where there are gradients: they must not cross `drjit.isolate_grad`.
    """
    if dr.grad_enabled(texture.packed) or not _is_traced():
        return look_up()
    backend = dr.backend_v(mi.Float)
    if dr.detail.scope(backend) != _lookups.scope:
        _lookups.found.clear()
    # The values keep their indices, so that no other variable has them.
    values = [texture.packed, *(getattr(si, name) for name in inputs)]
    key = (id(texture), *dr.detail.collect_indices(values))
    entry = _lookups.found.get(key)
    if entry is None:
        entry = look_up(), values
        _lookups.found[key] = entry
    _lookups.scope = dr.detail.scope(backend)
    return entry[0]


def _is_traced() -> bool:
    """Return whether Dr.Jit traces a program that is not frozen.

    In wavefronts a result would take memory. A recording of a frozen program ends the process if
    results of an earlier program are freed meanwhile.
    """
    return dr.flag(dr.JitFlag.SymbolicScope) and not dr.flag(dr.JitFlag.FreezingScope)


def sum_here(texture: Texture, x: Float, y: Float, active: Bool) -> list:
    """Sum the Gaussians at a point.

    Parameters
    ----------
    texture : mitsuba.Texture
        A ``gaussian_texture`` without a prefilter.
    x, y : Float
        In pixels, inside the image.
    active : Bool

    Returns
    -------
    list of Float
        One sum for each channel, without the background.
    """
    count, terms = texture.channels, value_terms(kernel_radius(texture.cutoff))
    number = NUM_SHAPE_PARAMS + count

    def look_up(packed: Float, x: Float, y: Float, arranged: Float) -> list:
        return sum_at_points(texture.cells, packed, number, x, y, active, terms, count, arranged)

    if not dr.grad_enabled(texture.packed):
        return look_up(texture.packed, x, y, texture.arranged)
    packed, px, py = dr.detach((texture.packed, x, y))
    value = look_up(packed, px, py, texture.arranged)
    return _with_gradient(value, look_up(texture.packed, x, y, None))


def sum_over_footprint(
    texture: Texture, si: Interaction, column: tuple, row: tuple, active: Bool
) -> list:
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
    inverse, valid = seen_metric(si, texture.transform.inverse, texture.angle)
    unit, blind = bound_covariance(inverse)
    sizes = (sx * sx, sx * sy, sy * sy)
    footprint = [dr.select(valid, f * s, 0) for f, s in zip(unit, sizes, strict=True)]
    blind &= valid & (sx * sy != 0)
    distant = is_minified(texture.pyramid, footprint)
    near, wide = active & ~distant, active & distant & ~blind
    count, cutoff = texture.channels, texture.cutoff
    number = NUM_SHAPE_PARAMS + count

    def look_up(source: tuple, x: Float, y: Float, arranged: Float) -> list:
        packed, pyramid, average = source
        sharp = sum_prefiltered(
            texture.sizes, packed, number, x, y, footprint, near, cutoff, arranged
        )
        far = where_any(
            wide, lambda: sum_pyramid(pyramid, x, y, footprint, wide), count, pyramid.values
        )
        seen = [dr.select(distant, f, n) for f, n in zip(far, sharp, strict=True)]
        return [dr.select(blind, m, s) for m, s in zip(average, seen, strict=True)]

    source = (texture.packed, texture.pyramid, texture.average)
    if not dr.grad_enabled(texture.packed):
        return look_up(source, x, y, texture.arranged)
    fixed, px, py = dr.detach((source, x, y))
    value = look_up(fixed, px, py, texture.arranged)
    return _with_gradient(value, look_up(source, x, y, None))


def _with_gradient(values: list, carriers: list) -> list:
    return [dr.replace_grad(v, c) for v, c in zip(values, carriers, strict=True)]

"""The memory that a texture or an environment holds between renderings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi

from eigengs_dr.backend.arrays import indices_of
from eigengs_dr.backend.doors import door
from eigengs_dr.backend.types import DrJitArray

from .emission import Emission
from .versions import Texture


@door
def resident_bytes(texture: Texture) -> int:
    """Return the bytes of the arrays that a plugin holds between renderings.

    Parameters
    ----------
    texture : mitsuba.Texture, mitsuba.Emitter or mitsuba.BSDF
        A ``gaussian_texture``, ``gaussian_environment`` or ``gaussian_relightable``, or another
        plugin, such as a ``bitmap`` or an ``envmap``.

    Returns
    -------
    int
        For Gaussians: the parameters and their derivatives, the lists of Gaussians and what else
        lookups read; and the distribution of the light, once it has been sampled. Plugins of one
        file share arrays, and each counts them. For another plugin: its parameters, as
        `mitsuba.traverse` shows them, and for an ``envmap`` its sampling table. Texels
        have 1, 2 or 4 channels, as in Dr.Jit's textures: three become four in the first rendering.
        Dr.Jit's allocator takes up to twice as much: it rounds the size of every array up to a
        power of two.

    Examples
    --------
    >>> import eigengs_dr as eg, mitsuba as mi
    >>> from eigengs_dr.plugins import resident_bytes, texture_of
    >>> g = eg.Gaussians.from_arrays([[4, 4]], [[0.5, 0, 0.5]], [[1]], size=(8, 8), space="data")
    >>> used = resident_bytes(mi.load_dict(texture_of(g)))
    """
    if not hasattr(texture, "__dict__"):
        tables = _table_bytes(texture) if texture.class_name() == "EnvironmentMapEmitter" else 0
        return tables + sum(_texel_bytes(value) for _, value in mi.traverse(texture))
    arrays: dict[tuple, int] = {}
    sampled = 0
    for value in _walk(vars(texture), {}):
        if isinstance(value, Emission):
            sampled += value.bytes
            continue
        if isinstance(value, mi.Texture2f):
            sampled += _texel_bytes(value.tensor())
            continue
        for array in (value, dr.grad(value)) if dr.grad_enabled(value) else (value,):
            arrays[indices_of([dr.detach(array)])] = dr.width(array) * dr.itemsize_v(array)
    return sum(arrays.values()) + sampled


def _texel_bytes(value: Any) -> int:
    """Return the bytes of a parameter if it is an array; for a tensor (..., C) with its padding."""
    if dr.is_tensor_v(value):
        *size, channels = value.shape
        return math.prod(size) * (1 << (channels - 1).bit_length()) * dr.itemsize_v(value.array)
    return dr.width(value) * dr.itemsize_v(value) if dr.is_jit_v(value) else 0


def _table_bytes(envmap: mi.Emitter) -> int:
    """Return the bytes of a sampling table: the luminance of texels and its sums over 4^k."""
    rows, columns, _ = mi.traverse(envmap)["data"].shape
    return round(7 / 3 * rows * (columns - 1)) * dr.itemsize_v(mi.Float)


def _walk(tree: Any, seen: dict[int, Any]) -> Iterator[DrJitArray | Emission | mi.Texture2f]:
    """Yield the flat arrays of Dr.Jit in objects and collections, distributions and tables."""
    if tree is None or isinstance(tree, type | str) or id(tree) in seen:
        return
    seen[id(tree)] = tree  # rows are made on demand: a freed one would pass its id on
    if dr.is_tensor_v(tree):
        tree = tree.array
    if isinstance(tree, Emission | mi.Texture2f) or (dr.is_jit_v(tree) and dr.depth_v(tree) == 1):
        yield tree
    else:
        inner = vars(tree) if hasattr(tree, "__dict__") else tree
        inner = inner.values() if isinstance(inner, dict) else inner
        for one in inner if isinstance(inner, Iterable) else ():
            yield from _walk(one, seen)

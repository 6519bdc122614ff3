"""What the plugins share: parameters, lists and lookups of a sum of Gaussians, and their memory.

Dr.Jit treats `self` as loop state, which silently loses gradients, and supports no custom
derivatives inside a virtual call. So the class below only passes arrays to the functions of
`eigengs_dr.raster.lookup.points` and `eigengs_dr.raster.lookup.prefilter`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi

from eigengs_dr.backend.arrays import indices_of
from eigengs_dr.backend.entry_points import entry_point
from eigengs_dr.backend.types import Bool, DrJitArray, Float, Texture
from eigengs_dr.raster.lookup.points import sum_at_points, value_terms

from . import properties
from .color import shown_channels, upload_table
from .cone import current_angle
from .emission import Emission
from .lookup import list_gaussians, make_table, sum_over_footprint
from .sources import SHAPES
from .texels import draw_texels


def plugin_of_sums(base: type) -> Any:
    """Return a class of plugins whose values are sums of Gaussians.

    Parameters
    ----------
    base : type
        A class of Mitsuba's plugins: they allow one base, and no mixin.
    """

    class PluginOfSums(base):
        """A set of Gaussians, what lookups need of it, and the lookups.

        Attributes
        ----------
        transform_name : str
            Parameter that places the picture.
        others : set of str
            Parameters on which lists and sums do not depend.
        drawn : (int, int) or None
            Columns and rows of texels, which lookups read instead of Gaussians.
        """

        transform_name: str
        others: frozenset[str]
        drawn: tuple[int, int] | None = None

        def read(self, props: mi.Properties, wrap: str, raw: bool) -> None:
            """Read the properties that all plugins have; `wrap` continues the picture."""
            self.plugin = props.plugin_name()
            self.source = properties.source_of(props)
            start = self.source.start
            self.file = properties.file_name(props)
            self.raw = raw
            self.cutoff = properties.cutoff(props, start.cutoff)
            self.memory = properties.memory(props)
            self.angle, self.follows = properties.prefilter(props)
            self.prefilter = dr.opaque(mi.Float, self.angle)
            self.sensor: mi.Sensor | None = None
            self.wrap = wrap
            self.width, self.height = start.width, start.height
            self.space, self.channels = start.space, start.channels
            self.spectra = upload_table() if mi.is_spectral else None
            self.changed = False

        def traverse(self, callback: mi.TraversalCallback) -> None:
            # C++ and `follow` look for objects alone.
            if type(callback) is mi.TraversalCallback or hasattr(callback, "only_objects"):
                return
            for name, tensor in self.source.tensors.items():
                callback.put(name, tensor, mi.ParamFlags.Differentiable)
            name = self.transform_name
            callback.put(name, getattr(self, name), mi.ParamFlags.NonDifferentiable)
            if self.drawn:
                return
            if self.sensor is not None:
                self.prefilter = current_angle(self.sensor)
            callback.put("prefilter", self.prefilter, mi.ParamFlags.NonDifferentiable)

        def parameters_changed(self, keys: list[str]) -> None:
            changed = set(keys) - self.others
            self.changed |= bool(changed)
            if "prefilter" in keys:
                self._set_prefilter()
            if not keys or changed:
                self._take_over(not keys or any(key in SHAPES for key in keys))

        def _take_over(self, moved: bool) -> None:
            """Take over the Gaussians; with new lists if they have moved."""
            if self.drawn:
                self.texels = draw_texels(self)
                return
            source, size = self.source, (self.width, self.height)
            settings = self.cutoff, self.wrap, self.filtered(), self.memory
            if shared := source.shared_table(*settings):
                self.table, self.part = shared
                return

            # The lists come first, since they may raise: old lists would read beyond new Gaussians.
            if moved:
                shape = source.decode(dr.detach(source.tensors)).shape
                lists = list_gaussians(shape, size, *settings)
            else:
                lists = self.table.lists
            # Rows of a texture that has changed stay floats: words would be another program.
            coded_for = size if self.memory.coded and not self.changed else None
            self.table = make_table(lists, self.cutoff, source.tensors, source.decode, coded_for)
            self.part = slice(None)

        # --- The prefilter -----------------------------------------------------------------------

        def follow(self, sensor: mi.Sensor) -> None:
            """Take footprints of the pixels of a sensor from now on, see `follow`."""
            current_angle(sensor)  # it raises where there is none
            if self.drawn:
                return
            filtered, self.sensor = self.filtered(), sensor
            if not filtered:
                self._take_over(True)

        def _set_prefilter(self) -> None:
            """Take over the parameter ``prefilter``, which may switch footprints on or off."""
            angle = properties.number_of(self.prefilter, "prefilter", self.plugin)
            properties.check_angle(angle, self.plugin)
            filtered, self.angle, self.sensor, self.follows = self.filtered(), angle, None, False
            if filtered != self.filtered():
                self._take_over(True)

        def filtered(self) -> bool:
            """Return whether lookups average over a footprint."""
            return self.follows or self.sensor is not None or self.angle > 0

        def pixel(self) -> Float | None:
            """Return the angle of a pixel; None if only rays know it."""
            if self.sensor is not None:
                return current_angle(self.sensor)
            return self.prefilter if self.angle else None

        # --- Lookups -----------------------------------------------------------------------------

        def sums_at(
            self, column: tuple, row: tuple, inside: Bool, seen: tuple | None = None
        ) -> list:
            """Sum all channels of the table, in all lanes; `seen` is the metric of a footprint."""
            (x, _), (y, _) = column, row
            if seen is None:
                packed = self.table.packed
                cells = self.table.lists.cells
                return sum_at_points(cells, packed, x, y, inside, value_terms(packed))
            return sum_over_footprint(self.table, column, row, inside, seen)

        def display(self, sums: list) -> list:
            """Return the channels, decoded and clamped unless `raw`, of sums without background."""
            background = self.table.background[self.part]
            return shown_channels(
                self, [s + b for s, b in zip(sums[self.part], background, strict=True)]
            )

        # --- Description -------------------------------------------------------------------------

        def prefilter_name(self) -> str:
            """Return the prefilter as properties say it."""
            return "true" if self.follows or self.sensor is not None else f"{self.angle:g}"

        def label(self) -> str:
            """Return the name of the plugin, with its id, for messages."""
            return f"{self.plugin} {self.id()!r}" if self.id() else self.plugin

    return PluginOfSums


# --- The memory that a plugin holds between renderings --------------------------------------------


@entry_point
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

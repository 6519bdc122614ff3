"""What the plugins share: parameters, lists and lookups of a sum of Gaussians.

Dr.Jit treats `self` as loop state, which silently loses gradients, and supports no custom
derivatives inside a virtual call. So the class below only passes arrays to the functions of
`eigengs_dr.raster.lookup.points` and `eigengs_dr.raster.lookup.prefilter`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from eigengs_dr.backend.types import Bool, Float
from eigengs_dr.raster.lookup.points import sum_at_points, value_terms

from . import properties
from .color import shown_channels, upload_table
from .cone import current_angle
from .lookup import list_gaussians, make_table, sum_over_footprint
from .sources import SHAPES


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
        """

        transform_name: str
        others: frozenset[str]

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
            table = make_table(lists, self.cutoff, source.tensors, source.decode, coded_for)
            # A texture that has changed may change its colours next, and needs all lists again.
            self.table = table if self.changed else replace(table, lists=lists)
            self.part = slice(None)

        # --- The prefilter -----------------------------------------------------------------------

        def follow(self, sensor: mi.Sensor) -> None:
            """Take footprints of the pixels of a sensor from now on, see `follow`."""
            current_angle(sensor)  # it raises where there is none
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

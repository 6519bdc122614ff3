"""Texels of ``gaussian_texture``: its sum of Gaussians, drawn at every change of a parameter.

Along a path, `prb` evaluates a material three times at each bounce, and each time sums the
Gaussians anew. Drawn once for each step, they cost what texels cost, and derivatives flow from the
texels to the Gaussians by the adjoint of `eigengs_dr.render`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import accumulate

import drjit as dr
import mitsuba as mi

from eigengs_dr.backend.types import Bool, Float, Mask, Record, Texture, UInt
from eigengs_dr.image.space import Space
from eigengs_dr.raster.lookup.footprint import bound_covariance
from eigengs_dr.raster.parameters import pack_parameters, unpack_parameters
from eigengs_dr.raster.render import render

from .color import keep_finite, shown_channels
from .lookup import derived


@dataclass(frozen=True, eq=False)
class Texels:
    """What a texture shows at the centres of texels, between which lookups are bilinear.

    Arrays rather than a ``mitsuba.Texture2f``, whose fractions of texels have 8 bits on cuda.

    Attributes
    ----------
    size : (int, int)
        Columns and rows. Level k has 2^k times fewer, rounded down, and at least one.
    channels : int
    wrap : {"repeat", "mirror", "clamp"}
    first : UInt, shape (levels,)
        The first texel of each level: one level, or with a prefilter all down to one texel.
    values : Float, shape (texels * stride,)
        As of `eigengs_dr.raster.parameters.pack_parameters`; may carry gradients.
    """

    size: tuple[int, int]
    channels: int
    wrap: str
    first: UInt
    values: Float

    def level_of(self, metric: list, valid: Bool) -> Float:
        """Return the level, between two, on which two deviations of a footprint are a texel.

        A long footprint has the level of a round one of its area: it is blurred across, and aliases
        along.

        Parameters
        ----------
        metric, valid
            From `eigengs_dr.plugins.cone.metric`.
        """
        (xx, xy, yy), _ = bound_covariance(metric)
        columns, rows = self.size
        square = dr.fma(xx, yy, -xy * xy) * (4 * columns * rows) ** 2  # of an area in texels
        level = dr.minimum(dr.log2(dr.maximum(square, 1)) / 4, dr.width(self.first) - 1)
        return dr.select(valid, level, 0)

    def at(self, x: Float, y: Float, active: Mask, level: Float | None = None) -> list:
        """Return the channels at a point of the picture, in texels; perhaps between two levels."""
        if level is None:
            return self._at(x, y, active, mi.UInt32(0))
        finer = mi.UInt32(level)
        coarser = dr.minimum(finer + 1, dr.width(self.first) - 1)
        two = (self._at(x, y, active, k) for k in (finer, coarser))
        return [dr.lerp(a, b, level - finer) for a, b in zip(*two, strict=True)]

    def _at(self, x: Float, y: Float, active: Mask, level: UInt) -> list:
        """Return the channels at a point on one level."""
        (right, below), corners = self._around(x, y, active, level)
        rows = ((dr.lerp(a, b, right), dr.lerp(c, d, right)) for a, b, c, d in corners)
        return [dr.lerp(upper, lower, below) for upper, lower in rows]

    def slopes(self, x: Float, y: Float, active: Mask) -> list[list]:
        """Return the derivatives of all channels by x, and by y."""
        (right, below), corners = self._around(x, y, active, mi.UInt32(0))
        along = [dr.lerp(b - a, d - c, below) for a, b, c, d in corners]
        return [along, [dr.lerp(c - a, d - b, right) for a, b, c, d in corners]]

    def _around(self, x: Float, y: Float, active: Mask, level: UInt) -> tuple[tuple, list[tuple]]:
        """Return the fractions of texels, and of each channel the texels around a point.

        Texels are those left and right above it, and left and right below it.
        """
        columns, rows = (dr.maximum(mi.UInt32(n) >> level, 1) for n in self.size)
        *across, right = neighbours(x * (mi.Float(columns) / self.size[0]), columns, self.wrap)
        *down, below = neighbours(y * (mi.Float(rows) / self.size[1]), rows, self.wrap)
        first = dr.gather(mi.UInt32, self.first, level, active)
        corners = [
            unpack_parameters(self.values, first + row * columns + column, self.channels, active)
            for row in down
            for column in across
        ]
        return (right, below), list(zip(*corners, strict=True))


def neighbours(x: Float, count: int | UInt, wrap: str = "clamp") -> tuple[UInt, UInt, Float]:
    """Return the cells of `count` with centres around x in [0, count], and the way between them.

    At a border both are the outermost cell, unless the image repeats.
    """
    position = x - 0.5
    before, last = dr.floor(position), mi.Int32(count) - 1
    left, right = mi.Int32(before), mi.Int32(before) + 1
    if wrap == "repeat":
        left, right = dr.select(left < 0, last, left), dr.select(right > last, 0, right)
    else:
        left, right = dr.maximum(left, 0), dr.minimum(right, last)
    return mi.UInt32(left), mi.UInt32(right), position - before


def draw_texels(texture: Texture) -> Texels:
    """Draw what a texture shows, in its size; derivatives flow back to its parameters.

    With a prefilter, also in smaller sizes: `eigengs_dr.render` averages over texels.
    """
    source, size = texture.source, (texture.width, texture.height)
    levels = max(size).bit_length() if texture.filtered() else 1
    sizes = [[max(n >> k, 1) for n in size] for k in range(levels)]
    first = accumulate((columns * rows for columns, rows in sizes[:-1]), initial=0)

    def compute(inputs: Record) -> Record:
        gaussians = source.gaussians(inputs)
        drawn = replace(
            gaussians,
            color=keep_finite(gaussians.color),
            background=keep_finite(gaussians.background),
            # Here sums are decoded as those of lookups, of which some are to stay logarithms.
            space=gaussians.space if gaussians.space.affine else Space("data"),
        )
        sums = dr.concat([render(drawn, c, r, texture.cutoff).array for c, r in sizes])
        count = gaussians.channels
        texel = dr.arange(mi.UInt32, dr.width(sums) // count)
        channels = [dr.gather(mi.Float, sums, texel * count + c) for c in range(count)]
        return {"texels": pack_parameters(shown_channels(texture, channels))}

    values = derived(source.tensors, compute)["texels"]
    dr.eval(values)
    channels = 3 if texture.channels == 2 else texture.channels  # z of normals
    return Texels(size, channels, texture.wrap, mi.UInt32(list(first)), values)

"""Texels of ``gaussian_texture``: its sum of Gaussians, drawn at every change of a parameter.

Along a path, `prb` evaluates a material three times at each bounce, and each time sums the
Gaussians anew. Drawn once for each step, they cost what texels cost, and derivatives flow from the
texels to the Gaussians by the adjoint of `eigengs_dr.render`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from eigengs_dr.backend.types import Float, Mask, Record, Texture, UInt
from eigengs_dr.image.space import Space
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
        Columns and rows.
    channels : int
    wrap : {"repeat", "mirror", "clamp"}
    values : Float, shape (rows * columns * stride,)
        As of `eigengs_dr.raster.parameters.pack_parameters`; may carry gradients.
    """

    size: tuple[int, int]
    channels: int
    wrap: str
    values: Float

    def at(self, x: Float, y: Float, active: Mask) -> list:
        """Return the channels at a point of the picture, in texels."""
        (right, below), corners = self._around(x, y, active)
        rows = ((dr.lerp(a, b, right), dr.lerp(c, d, right)) for a, b, c, d in corners)
        return [dr.lerp(upper, lower, below) for upper, lower in rows]

    def slopes(self, x: Float, y: Float, active: Mask) -> list[list]:
        """Return the derivatives of all channels by x, and by y."""
        (right, below), corners = self._around(x, y, active)
        along = [dr.lerp(b - a, d - c, below) for a, b, c, d in corners]
        return [along, [dr.lerp(c - a, d - b, right) for a, b, c, d in corners]]

    def _around(self, x: Float, y: Float, active: Mask) -> tuple[tuple, list[tuple]]:
        """Return the fractions of texels, and of each channel the texels around a point.

        Texels are those left and right above it, and left and right below it.
        """
        columns, rows = self.size
        *across, right = neighbours(x, columns, self.wrap)
        *down, below = neighbours(y, rows, self.wrap)
        corners = [
            unpack_parameters(self.values, row * columns + column, self.channels, active)
            for row in down
            for column in across
        ]
        return (right, below), list(zip(*corners, strict=True))


def neighbours(x: Float, count: int, wrap: str = "clamp") -> tuple[UInt, UInt, Float]:
    """Return the cells of `count` with centres around x in [0, count], and the way between them.

    At a border both are the outermost cell, unless the image repeats.
    """
    position = x - 0.5
    before, last = dr.floor(position), count - 1
    left, right = mi.Int32(before), mi.Int32(before) + 1
    if wrap == "repeat":
        left, right = dr.select(left < 0, last, left), dr.select(right > last, 0, right)
    else:
        left, right = dr.maximum(left, 0), dr.minimum(right, last)
    return mi.UInt32(left), mi.UInt32(right), position - before


def draw_texels(texture: Texture) -> Texels:
    """Draw what a texture shows, in its size; derivatives flow back to its parameters."""
    source, cutoff, size = texture.source, texture.cutoff, (texture.width, texture.height)

    def compute(inputs: Record) -> Record:
        gaussians = source.gaussians(inputs)
        drawn = replace(
            gaussians,
            color=keep_finite(gaussians.color),
            background=keep_finite(gaussians.background),
            # Here sums are decoded as those of lookups, of which some are to stay logarithms.
            space=gaussians.space if gaussians.space.affine else Space("data"),
        )
        sums = render(drawn, *size, cutoff).array
        texel, count = dr.arange(mi.UInt32, size[0] * size[1]), gaussians.channels
        channels = [dr.gather(mi.Float, sums, texel * count + c) for c in range(count)]
        return {"texels": pack_parameters(shown_channels(texture, channels))}

    values = derived(source.tensors, compute)["texels"]
    dr.eval(values)
    channels = 3 if texture.channels == 2 else texture.channels  # z of normals
    return Texels(size, channels, texture.wrap, values)

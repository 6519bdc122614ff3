"""A Hilbert curve through the pixels or the tiles of an image: close places are close in memory."""

from __future__ import annotations

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...backend.arrays import make_divisor, types_of
from ...backend.types import UInt
from ...gaussian.gaussians import Gaussians
from ...raster.tiles import Grid


def hilbert_curve(width: int, height: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return columns and rows (W H,) of the pixels of an image in the order of a Hilbert curve.

    The curve fills the next power of two. Each level of it joins four copies of the last one: the
    first with columns and rows swapped, two as they are, the last swapped and turned by 180 degrees
    (Hilbert, Ueber die stetige Abbildung einer Linie auf ein Flaechenstueck, 1891).
    """
    x = y = np.zeros(1, np.int32)
    for level in range((max(width, height) - 1).bit_length()):
        side = 1 << level
        x, y = (
            np.concatenate([y, x, x + side, 2 * side - 1 - y]),
            np.concatenate([x, y + side, y + side, side - 1 - x]),
        )
    inside = (x < width) & (y < height)
    return x[inside], y[inside]


def order_along_hilbert(gaussians: Gaussians, images: int = 1) -> UInt:
    """Return the order of Gaussians along a Hilbert curve through the tiles, image after image.

    It is that of `hilbert_curve`, from the bits of columns and rows, the highest first.
    """
    types, grid = types_of(gaussians.mean), Grid(gaussians.width, gaussians.height, images=images)
    limits = (dr.opaque(types.Int, side) for side in (grid.width - 1, grid.height - 1))
    x, y = (
        types.UInt(dr.clip(types.Int(v), 0, limit)) >> 2
        for v, limit in zip(gaussians.mean, limits, strict=True)
    )
    levels = (max(grid.nx, grid.ny) - 1).bit_length()

    def descend(level: UInt, x: UInt, y: UInt, key: UInt) -> tuple:
        level = level - 1
        right, low = (x >> level) & 1, (y >> level) & 1
        key = (key << 2) | (2 * right + (right ^ low))
        turn = dr.select(right == 1, types.UInt(0xFFFFFFFF), 0)  # counts from the other side
        return level, dr.select(low == 0, y ^ turn, x), dr.select(low == 0, x ^ turn, y), key

    image = types.UInt(0)
    if images > 1:
        divisor = make_divisor(types, len(gaussians) // images)
        image, _ = divisor.divmod(dr.arange(types.UInt, len(gaussians)))
    start = dr.opaque(types.UInt, levels), x, y, image
    *_, key = dr.while_loop(
        start, lambda level, *_: level > 0, descend, label="walk along the curve", max_iterations=-1
    )
    return dr.argsort(key)

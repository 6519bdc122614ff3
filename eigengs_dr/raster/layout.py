"""Where the parameters of Gaussians lie in memory, and how a lane gathers them."""

from __future__ import annotations

from typing import Any

import drjit as dr

from ..backend.arrays import ArrayTypes, types_of


def pack_parameters(values: list) -> Any:
    """Store the parameters of N splats one splat after another, padded to a multiple of 4 floats.

    Gathers of 4 neighbours are 8 times as fast as 4 gathers on the CPU. Arrays that wrap NumPy's
    memory may not be aligned and silently lose that, so this always copies.
    """
    types = types_of(values[0])
    stride = -(-len(values) // 4) * 4
    count = max(dr.width(v) for v in values)
    rows = [*values, *[types.Float(0)] * (stride - len(values))]
    packed = dr.empty(types.Float, stride * count)
    dr.scatter(packed, types.FloatX(rows), dr.arange(types.UInt, count))
    return packed


def gather_run(types: ArrayTypes, source: Any, index: Any, length: int, active: Any) -> list:
    """Gather ``source[index * length : (index + 1) * length]`` by packets if the length is even."""
    shape = (length, dr.width(index))
    return list(dr.gather(types.FloatX, source, index, active, shape=shape))


def unpack_parameters(packed: Any, index: Any, number: int, active: Any = True) -> list:
    """Gather the first `number` parameters of the splats `index`; undoes `pack_parameters`."""
    return gather_run(types_of(packed), packed, index, -(-number // 4) * 4, active)[:number]


def gather_index(types: ArrayTypes, splat: Any, i: Any, active: Any) -> Any:
    """``splat[i]`` through a gather of a pair, 8 times as fast as a single one on the CPU."""
    pair = dr.gather(types.UInt2, splat, i >> 1, active)
    return dr.select((i & 1) == 0, pair[0], pair[1])

"""The layout of parameters in memory, and gathers from it."""

from __future__ import annotations

from typing import Any

import drjit as dr

from ..backend.arrays import ArrayTypes, types_of


def pack_parameters(values: list) -> Any:
    """Store the parameters of N Gaussians one Gaussian after another.

    On the CPU, one gather of 4 neighbours is 8 times as fast as 4 gathers. It needs aligned memory,
    which arrays that share NumPy's memory may lack, so the parameters are always copied.

    Parameters
    ----------
    values : list of Float, shape (N,)
        One array for each parameter.

    Returns
    -------
    Float, shape (N * stride,)
        The stride is the number of parameters, padded to a multiple of 4.
    """
    types = types_of(values[0])
    stride = -(-len(values) // 4) * 4
    count = max(dr.width(v) for v in values)
    rows = [*values, *[types.Float(0)] * (stride - len(values))]
    packed = dr.empty(types.Float, stride * count)
    dr.scatter(packed, types.FloatX(rows), dr.arange(types.UInt, count))
    return packed


def gather_run(types: ArrayTypes, source: Any, index: Any, length: int, active: Any) -> list:
    """Gather ``source[index * length : (index + 1) * length]``, in packets if the length is even.

    Return a list of `length` Float.
    """
    shape = (length, dr.width(index))
    return list(dr.gather(types.FloatX, source, index, active, shape=shape))


def unpack_parameters(packed: Any, index: Any, number: int, active: Any = True) -> list:
    """Gather the first `number` parameters of the Gaussians `index`; undo `pack_parameters`."""
    return gather_run(types_of(packed), packed, index, -(-number // 4) * 4, active)[:number]


def gather_index(types: ArrayTypes, splat: Any, i: Any, active: Any) -> Any:
    """Return ``splat[i]``, on the CPU by the gather of a pair: 8 times as fast as a single gather.

    `splat` must have an even length.
    """
    if types.backend == "cuda":
        return dr.gather(types.UInt, splat, i, active)
    pair = dr.gather(types.UInt2, splat, i >> 1, active)
    return dr.select((i & 1) == 0, pair[0], pair[1])

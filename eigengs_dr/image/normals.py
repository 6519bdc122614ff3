"""Normals as codes: a unit vector n is stored as ``(n + 1) / 2``, as in files of normal maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

SHORTEST = 1e-6
"""Squared length below which a vector has no direction; it stays nearly zero."""


def renormalize(codes: Any) -> Any:
    """Scale the vectors of a normal map to the length 1.

    Parameters
    ----------
    codes : ndarray of float, shape (..., 3), or Dr.Jit tensor, shape (H, W, 3)
        Codes; 0.5 is a component of 0.

    Returns
    -------
    array, same shape and type
        Codes of unit vectors. Dr.Jit tensors carry derivatives.
    """
    if isinstance(codes, np.ndarray):
        unit = unit_codes(list(np.moveaxis(codes, -1, 0)))
        return np.stack(unit, axis=-1).astype(codes.dtype, copy=False)
    import drjit as dr  # loads libLLVM

    flat = codes.array
    Float, UInt = type(flat), dr.uint32_array_t(type(flat))
    # Gathers, because slices of tensors compile a program for every size.
    index = dr.arange(UInt, dr.width(flat))
    axis = index % 3
    rows = [dr.gather(Float, flat, index - axis + k) for k in range(3)]
    x, y, z = unit_codes(rows)
    return type(codes)(dr.select(axis == 0, x, dr.select(axis == 1, y, z)), codes.shape)


def unit_codes(channels: Sequence[Any]) -> list[Any]:
    """Return the codes of the unit vectors along three channels of codes; see `renormalize`."""
    vector = [2 * channel - 1 for channel in channels]
    square = sum((v * v for v in vector[1:]), vector[0] * vector[0])
    if isinstance(square, np.ndarray):
        scale = 0.5 / np.sqrt(np.maximum(square, SHORTEST))
    else:
        import drjit as dr

        from ..backend.arrays import rsqrt

        scale = 0.5 * rsqrt(dr.maximum(square, SHORTEST))
    return [v * scale + 0.5 for v in vector]

"""Gaussians in the units of the kernels, and their layout in memory.

Kernels evaluate ``exp(-1/2 |F (x - mu)|^2)`` as ``2^-|s F (x - mu)|^2`` with ``s = EXP2_SCALE``,
which saves a multiplication per pixel. Factors, cutoffs and covariances of footprints are therefore
scaled by powers of s before they reach the kernels. In memory, the parameters of a Gaussian are
adjacent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr

from ..backend.arrays import ArrayTypes, gather_run, types_of
from ..backend.types import Bool, Float, Mask, UInt
from ..gaussian.gaussians import Gaussians

EXP2_SCALE = math.sqrt(0.5 / math.log(2))
"""The scale s in ``exp(-q / 2) = 2^-(s^2 q)``."""

NUM_SHAPE_PARAMS = 5
"""Number of parameters of a Gaussian without its colour: mean x, mean y, a, b, c."""


@dataclass
class KernelParameters:
    """A set of Gaussians in the units of the kernels.

    Attributes
    ----------
    shape : list of 5 Float, shape (N,)
        Mean x and mean y in pixels; a, b, c in 1 / pixels, times `EXP2_SCALE`.
    color : list of C Float, shape (N,)
    background : list of C Float, shape (1,)
    """

    shape: list
    color: list
    background: list


def kernel_shape(gaussians: Gaussians) -> list:
    """Return the 5 shape parameters of a set, see `KernelParameters`; differentiable."""
    return [*gaussians.mean, *[f * EXP2_SCALE for f in gaussians.factor]]


def detached_shape(gaussians: Gaussians) -> list:
    """Return `kernel_shape` without derivatives; all rows have the length N."""
    zeros = dr.zeros(types_of(gaussians.mean).Float, len(gaussians))
    return [dr.detach(v) + zeros for v in kernel_shape(gaussians)]


def kernel_radius(cutoff: float) -> float:
    """Return a cutoff in the units of the kernels.

    Parameters
    ----------
    cutoff : float
        Standard deviations.
    """
    return EXP2_SCALE * cutoff


def kernel_covariance(covariance: list) -> list:
    """Return the entries of a covariance in the units of the kernels.

    Parameters
    ----------
    covariance : list of Float
        Entries such as xx, xy, yy of a footprint, in pixels squared.
    """
    return [entry * (1 / EXP2_SCALE**2) for entry in covariance]


def pack_parameters(values: list, before: Sequence[float] = ()) -> Float:
    """Store the parameters of N Gaussians, one Gaussian after another.

    On the CPU, one gather of 4 adjacent values is 8 times as fast as 4 gathers. It needs aligned
    memory. Arrays that share NumPy's memory may not be aligned, so the parameters are always
    copied.

    Parameters
    ----------
    values : list of Float, shape (N,)
        One array for each parameter.
    before : sequence of float, optional
        Parameters of an additional Gaussian before the first.

    Returns
    -------
    Float, shape (N * stride,)
        The stride is the number of parameters, rounded up to 2 or to a multiple of 4.
    """
    types, stride = types_of(values[0]), _stride(len(values))
    count = max(dr.width(v) for v in values)
    rows = [*values, *[types.Float(0)] * (stride - len(values))]
    first = 1 if before else 0
    packed = dr.empty(types.Float, stride * (first + count))
    if before:
        blank = types.FloatX([*before, *[0.0] * (stride - len(before))])
        dr.scatter(packed, blank, types.UInt(0))
    dr.scatter(packed, types.FloatX(rows), dr.arange(types.UInt, count) + first)
    return packed


def _stride(number: int) -> int:
    """Return the distance of two Gaussians in memory, such that packet gathers are possible."""
    return 2 if number <= 2 else -(-number // 4) * 4


def unpack_parameters(packed: Float, index: UInt, number: int, active: Mask = True) -> list:
    """Gather the first `number` parameters of the Gaussians `index`; inverts `pack_parameters`."""
    return gather_run(types_of(packed), packed, index, _stride(number), active)[:number]


def gather_index(types: ArrayTypes, splat: UInt, i: UInt, active: Bool) -> UInt:
    """Return ``splat[i]``; on the CPU by gathering a pair, 8 times as fast as a single gather.

    `splat` must have an even length.
    """
    if types.backend != "llvm":
        return dr.gather(types.UInt, splat, i, active)
    pair = dr.gather(types.UInt2, splat, i >> 1, active)
    return dr.select((i & 1) == 0, pair[0], pair[1])

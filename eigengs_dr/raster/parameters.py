"""Conversion of Gaussians to the units of the kernels.

Kernels evaluate ``exp(-1/2 |F (x - mu)|^2)`` as ``2^-|s F (x - mu)|^2`` with ``s = EXP2_SCALE``,
which saves a product for every pixel. Factors, cutoffs and covariances of footprints are therefore
scaled by powers of s before they reach the kernels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr

from ..backend.arrays import types_of
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


def kernel_parameters(gaussians: Gaussians) -> KernelParameters:
    """Return the parameters of a set without decoding its colours; differentiable."""
    return KernelParameters(
        kernel_shape(gaussians), list(gaussians.color), list(gaussians.background)
    )


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

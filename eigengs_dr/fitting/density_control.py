"""Density control: drop the Gaussians of least use, and add Gaussians where the error is large."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import types_of
from ..gaussian.concatenate import concatenate
from ..gaussian.gaussians import Gaussians
from .placement.peaks import residual_peaks
from .redistribute import residual
from .solvers.conjugate_gradient import inner_products, solve

Array = NDArray[np.floating]


SOLVE_STEPS = 5
"""Steps of the colour solve after dropping Gaussians, so that their neighbours replace them."""


def removal_cost(
    gaussians: Gaussians,
    target: NDArray[np.float32],
    weight: Array | None = None,
) -> NDArray[np.float64]:
    """Return how much the squared error grows if one Gaussian is removed, for each Gaussian.

    With the residual r of the set, ``|r + c_n w_n|^2 - |r|^2 = c_n^2 <w_n, w_n> + 2 c_n <w_n, r>``,
    summed over channels. Cost: two adjoints with respect to colours.

    Parameters
    ----------
    gaussians : Gaussians
    target : ndarray of float32, shape (H, W, C)
        The image in the space of the set.
    weight : ndarray, shape (H, W, C), optional
        Factor of the errors before squaring.

    Returns
    -------
    ndarray of float64, shape (N,)
        Negative if the set would be better without the Gaussian.
    """
    counts = np.ones_like(target) if weight is None else np.square(weight).astype(np.float32)
    missed = residual(gaussians, target) * counts
    along = inner_products(gaussians, missed)
    own = inner_products(gaussians, counts, squared=True)
    color = gaussians.to_arrays()["color"].astype(np.float64)
    return (color * (color * own + 2 * along)).sum(axis=1)


def prune(
    gaussians: Gaussians,
    target: NDArray[np.float32],
    count: int,
    weight: Array | None = None,
) -> Gaussians:
    """Keep the `count` Gaussians of largest removal cost, in order, and solve for the colours.

    For the other parameters see `removal_cost`. With a weight the colours stay, because the solve
    minimises the error without weights.
    """
    value = removal_cost(gaussians, target, weight)
    kept = np.sort(np.argsort(-value, kind="stable")[:count])
    if weight is not None:
        return gaussians[kept]
    return solve(gaussians[kept], target, SOLVE_STEPS, warm_start=True).gaussians


def densify(
    gaussians: Gaussians,
    target: NDArray[np.float32],
    count: int,
    weight: Array | None = None,
) -> Gaussians:
    """Add round Gaussians where they reduce the error most, until the set has `count`.

    For the other parameters see `removal_cost`. The result may have fewer Gaussians, if
    `residual_peaks` finds too few places. A set with `count` or more Gaussians stays as it is.
    """
    if count <= len(gaussians):
        return gaussians
    missed = residual(gaussians, target)
    mean, size, color = residual_peaks(missed, count - len(gaussians), _spacing(gaussians), weight)
    if not len(mean):
        return gaussians
    sharp = 1 / size
    added = Gaussians.from_arrays(
        mean,
        np.stack([sharp, 0 * sharp, sharp], axis=1),
        color,
        size=(gaussians.width, gaussians.height),
        space=gaussians.space,
        backend=types_of(gaussians.mean).backend,
        cutoff=gaussians.cutoff,
    )
    return concatenate([gaussians, added.bounded()])


def _spacing(gaussians: Gaussians) -> float:
    return math.sqrt(gaussians.width * gaussians.height / len(gaussians))

"""Fewer splats where they are worth least, more where an image is missed most."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import types_of
from ..gaussian.gaussians import Gaussians, concatenate
from .placement.density import residual_peaks
from .redistribute import residual
from .solvers.conjugate_gradient import inner_products, solve

Array = NDArray[np.floating]


SOLVE_STEPS = 5
"""Steps of the colour solve after splats were dropped: their neighbours take over."""


def removal_cost(
    gaussians: Gaussians,
    target: NDArray[np.float32],
    weight: Array | None = None,
) -> NDArray[np.float64]:
    """Rise of the squared error if a splat were gone and all others stayed as they are.

    With the residual r of the set, ``|r + c_n w_n|^2 - |r|^2 = c_n^2 <w_n, w_n> + 2 c_n <w_n, r>``,
    summed over channels. Cost: two adjoints with respect to colours.

    Parameters
    ----------
    gaussians : Gaussians
    target : ndarray of float32, shape (H, W, C)
        The image in the space of the set.
    weight : ndarray, shape (H, W, C), optional
        What errors are multiplied by before they are squared.

    Returns
    -------
    ndarray, shape (N,)
        Negative where the set would be better without the splat.
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
    """Keep the `count` splats that are worth the most, in their order, and solve for the colours.

    Parameters are those of `removal_cost`. With a weight colours stay: those that are solved for
    minimise the error without it.
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
    """Add round splats where one takes most from the error, until there are `count`.

    Parameters are those of `removal_cost`. Fewer are added where the image has no more places, see
    `residual_peaks`; none to a set that has as many.
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

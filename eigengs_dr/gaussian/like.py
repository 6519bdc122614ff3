"""Other Gaussians for the image of a set."""

from __future__ import annotations

from numpy.typing import ArrayLike

from ..backend.arrays import types_of
from .gaussians import Gaussians


def like(
    gaussians: Gaussians,
    mean: ArrayLike,
    factor: ArrayLike,
    color: ArrayLike,
    background: ArrayLike | None = None,
) -> Gaussians:
    """Create a set from NumPy arrays, with the size, space, cutoff and backend of another set.

    For the arrays and errors see `eigengs_dr.Gaussians.from_arrays`.
    """
    return Gaussians.from_arrays(
        mean,
        factor,
        color,
        background,
        size=(gaussians.width, gaussians.height),
        space=gaussians.space,
        backend=types_of(gaussians.mean).backend,
        cutoff=gaussians.cutoff,
    )

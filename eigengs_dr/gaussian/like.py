"""Gaussians from what holds or resembles them."""

from __future__ import annotations

from typing import Any

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


def set_of(source: Any) -> Gaussians:
    """Return a set, or the set of a fit.

    Raises
    ------
    TypeError
        If the source is something else.
    ValueError
        If the fit has a mean image of pixels, which the set lacks.
    """
    if isinstance(source, Gaussians):
        return source
    if not hasattr(source, "trace") or not hasattr(source, "gaussians"):
        raise TypeError(f"{type(source).__name__} is no set of Gaussians; pass Gaussians or a Fit")
    if source.mean_image is not None:
        raise ValueError("the fit has a mean image of pixels, which its set lacks; use .gaussians")
    found: Gaussians = source.gaussians
    return found

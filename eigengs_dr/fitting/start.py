"""What a fit starts from: a set of the user, the file of a set, or a model."""

from __future__ import annotations

import os
from dataclasses import replace

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import ArrayTypes, types_in, types_of
from ..backend.selection import select
from ..gaussian.gaussians import Fitted, Gaussians, set_of
from .method import Method, Model
from .objective import Pixels
from .options import FitOptions, Start


def load_start(start: Start | Fitted, backend: str | None) -> Gaussians | Model:
    """Return the set or the model of a start, without the derivatives of the caller.

    Raises
    ------
    ValueError
        If the set is on another backend, or its file holds no set.
    TypeError
        If the start is something else.
    """
    if isinstance(start, (str, os.PathLike)):
        return Gaussians.load(start, backend)
    loaded = start if isinstance(start, Model) else dr.detach(set_of(start))
    current = types_of(set_in(loaded).mean).backend
    if backend not in (None, current):
        raise ValueError(
            f"the start is on backend {current!r}, not on {backend!r}; load it with "
            f"backend={backend!r}, or leave the backend out"
        )
    return loaded


def set_in(start: Gaussians | Model) -> Gaussians:
    """Return the set of a start."""
    return start if isinstance(start, Gaussians) else start.gaussians


def types_for(start: Gaussians | Model | None, backend: str | None) -> ArrayTypes:
    """Return the backend and the precision of a fit: those of its start."""
    return types_in(select(backend)) if start is None else types_of(set_in(start).mean)


def check_start(
    start: Gaussians, size: tuple[int, int], channels: int, space: str, options: FitOptions
) -> None:
    """Raise ValueError unless a start fits the image and the options."""
    count, (width, height) = len(start), size
    if options.gaussians not in (None, count):
        raise ValueError(
            f"gaussians is {options.gaussians}, but the start has {count}; leave the number or "
            "the start out"
        )
    if count > width * height:
        raise ValueError(
            f"the start has {count} Gaussians, more than an image of {width}x{height} has pixels; "
            "leave the start out"
        )
    if space != start.space:
        raise ValueError(
            f"space is {space!r}, but the start is in {start.space!r}; use space "
            f"{start.space!r}, or another start"
        )
    if channels != start.channels:
        raise ValueError(
            f"the image has {channels} channels, but the start has {start.channels}; use another "
            "start"
        )


def start_from(
    start: Gaussians | Model,
    objective: Pixels,
    method: Method,
    pixels: NDArray[np.float32],
    moves: bool,
) -> tuple[Pixels, Gaussians]:
    """Return the objective, and the Gaussians of a start at the size of the image.

    Parameters
    ----------
    start : Gaussians or Model
        A set in the units of the fit.
    objective : Pixels
    method : Method
    pixels : ndarray of float32, shape (H, W, C)
        The image that a model encodes.
    moves : bool
        Whether a descent follows, which needs means inside of the image.
    """
    if not isinstance(start, Gaussians):
        objective, gaussians = method.start_from_model(objective, start, pixels)
        return objective, gaussians.bounded() if moves else gaussians
    gaussians = replace(start.scaled(*objective.size), cutoff=float(method.cutoff))
    if moves:
        gaussians = gaussians.bounded()
    return objective, method.start_from(objective, gaussians)

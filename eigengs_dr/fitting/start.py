"""What a fit starts from: a set of the user, the file of a set, or a model."""

from __future__ import annotations

import os
from dataclasses import replace

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import types_of
from ..backend.types import Float
from ..gaussian.gaussians import Fitted, Gaussians, concatenate, set_of
from ..image.space import Space
from .control import densify, in_order, prune
from .method import Method, Model
from .objective import Pixels
from .options import FitOptions, Start
from .placement.redistribution import Owners, error_by_pixel
from .solve import solve

MAX_ERROR, TRUSTED_STEPS = 0.4, 50
"""Largest squared error of a start over that of a placement, and the steps from which on it holds;
it rises to 1 for no steps. A placement gains more from many steps than Gaussians that are fitted
already: of eight frames that move by a pixel or grow (astronaut, 500 Gaussians, 20 to 100 steps),
0.4 ends at most 0.28 dB below fits of their own, 0.55 and 1 up to 0.5 and 0.8 dB."""


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


def check_start(
    start: Gaussians, size: tuple[int, int], channels: int, space: Space, options: FitOptions
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
    iterations: int,
    seed: int,
) -> tuple[Pixels, Gaussians, bool]:
    """Return the objective, what a descent starts from, and whether it holds the user's Gaussians.

    Those of a set stay where they fit the image, see `keep_fitting`. Those of a model all stay: the
    user chose its shapes.

    Parameters
    ----------
    start : Gaussians or Model
        A set in the units of the fit.
    objective : Pixels
    method : Method
    pixels : ndarray of float32, shape (H, W, C)
        The image that a model encodes.
    iterations : int
        Steps of the descent that follows, which needs means inside of the image.
    seed : int
        Seed of a placement.
    """
    if not isinstance(start, Gaussians):
        objective, gaussians = method.start_from_model(objective, start, pixels)
        return objective, gaussians.bounded() if iterations else gaussians, True
    gaussians = replace(start.scaled(*objective.size), cutoff=float(method.cutoff))
    if not iterations or method.place.has_colors:
        gaussians = gaussians.bounded() if iterations else gaussians
        return objective, method.start_from(objective, gaussians), True
    started = method.start_from(objective, gaussians.bounded())
    return objective, *keep_fitting(started, objective, method, iterations, seed)


def keep_fitting(
    start: Gaussians, objective: Pixels, method: Method, iterations: int, seed: int
) -> tuple[Gaussians, bool]:
    """Keep the Gaussians of a start where they fit an image better than a placement does.

    A Gaussian stays if the squared error of what it owns, see `Owners`, is at most that of as many
    Gaussians that the method places by the image. The others make room for those of the placement
    that are better there. If this set is not much better than the placement, see `MAX_ERROR`, the
    placement is the start. Cost: a placement, three colour solves and a pruning, about 30
    steps long; where all Gaussians stay, a placement and a solve.

    Parameters
    ----------
    start : Gaussians
        A set with the best colours for the image.
    objective : Pixels
    method : Method
    iterations : int
        Steps of the descent that follows.
    seed : int
        Seed of the placement.

    Returns
    -------
    Gaussians
        As many as the start has.
    kept : bool
        Whether it holds Gaussians of the start.
    """
    placed = method.place_and_solve(objective, len(start), seed)
    with dr.suspend_grad():
        errors = [error_by_pixel(one, objective) for one in (start, placed)]
        stays = _fits_better(start, *errors)
        mixed = start
        if not stays.all() and stays.any():
            mixed = _mixed(start, placed, stays, ~_fits_better(placed, *errors), objective, method)
        errors.append(error_by_pixel(mixed, objective))
        old, new, both = (dr.sum(error)[0] for error in errors)
    largest = 1 - (1 - MAX_ERROR) * min(1, iterations / TRUSTED_STEPS)
    if min(old, both) > largest * new:
        return placed, False
    return (mixed if both < old else start), True


def _fits_better(gaussians: Gaussians, first: Float, second: Float) -> NDArray[np.bool_]:
    """Return where the first error (pixels,) of what a Gaussian owns is at most the second."""
    shares = [share.numpy() for share in Owners.of(gaussians).collect(first, second)]
    return np.less_equal(*shares)


def _mixed(
    start: Gaussians,
    placed: Gaussians,
    stays: NDArray[np.bool_],
    comes: NDArray[np.bool_],
    objective: Pixels,
    method: Method,
) -> Gaussians:
    """Return as many Gaussians as a start has: those that stay, and those that come instead."""
    parts = [start[stays]]
    if comes.any():
        parts.append(replace(placed[comes], background=0 * placed.background))
    both = solve(concatenate(parts), objective, method.solve_steps, warm_start=True)
    both = densify(prune(both, objective, len(start)), objective, len(start))
    if len(both) < len(start):  # no place is left where another Gaussian would help
        return start
    return in_order(solve(both, objective, method.solve_steps, warm_start=True))

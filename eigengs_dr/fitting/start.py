"""The start of a fit: Gaussians with colours, placed by the image, of another set, or of a model.

``PLACEMENTS`` names the placements that see only the size of the image: a hexagonal grid of round
Gaussians, and random Gaussians. The placement by the image itself is that of
`eigengs_dr.fitting.placement.adaptive`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import types_of
from ..gaussian.covariance import factor_from_covariance
from ..gaussian.gaussians import Gaussians, one_image, set_of
from ..image.color import decode
from .density_control import DensityControl
from .descent import FitProblem
from .options import FitOptions, Model
from .placement.adaptive import place_adaptive
from .solvers.conjugate_gradient import solve
from .target import FitTarget, make_target

DEVIATION = 0.65
"""Standard deviation of a Gaussian, relative to the square root of the area per Gaussian. A smaller
one leaves gaps; a larger one gains nothing, slows the colour solve and makes the colours grow."""


def place_grid(
    image: NDArray[np.floating], count: int, generator: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Place round Gaussians in rows; shift every second row by half a distance.

    For parameters and results see `place_random`; the generator
    is not used. The count may be any number: rows differ by at most one Gaussian.
    """
    height, width = image.shape[:2]
    spacing = math.sqrt(width * height / count)
    # In a hexagonal grid with one point per area s^2, rows are sqrt(3) / 2 of a distance apart.
    rows = min(count, max(1, round(height / spacing * math.sqrt(2 / math.sqrt(3)))))
    starts = np.arange(rows + 1) * count // rows
    row = np.repeat(np.arange(rows), np.diff(starts))
    number = np.diff(starts)[row]
    place = np.arange(count) - starts[row] + np.where(number > 1, 0.25 + 0.5 * (row % 2), 0.5)
    mean = np.stack([place * width / number, (row + 0.5) * height / rows], axis=-1)
    sharpness = 1 / (DEVIATION * spacing)
    return mean, np.tile([sharpness, 0, sharpness], (count, 1))


def place_random(
    image: NDArray[np.floating], count: int, generator: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw means uniformly in the image, and shapes as GaussianImage does.

    The covariance is ``L L^T`` with ``L = [[l1 + 0.5, 0], [l2, l3 + 0.5]]`` pixels and l1, l2, l3
    uniform in [0, 1].

    Parameters
    ----------
    image : ndarray, shape (H, W, C)
        The function uses only its size.
    count : int
        Number of Gaussians.
    generator : numpy.random.Generator

    Returns
    -------
    mean : ndarray, shape (count, 2)
        In pixels.
    factor : ndarray, shape (count, 3)
        a, b, c in 1 / pixels; see `eigengs_dr.Gaussians`.
    """
    height, width = image.shape[:2]
    mean = generator.uniform(0, [width, height], (count, 2))
    l1, l2, l3 = (generator.uniform(0, 1, (count, 3)) + np.array([0.5, 0, 0.5])).T
    return mean, factor_from_covariance(l1 * l1, l1 * l2, l2 * l2 + l3 * l3)


Placement = Callable[
    [NDArray[np.floating], int, np.random.Generator],
    tuple[NDArray[np.float64], NDArray[np.float64]],
]
"""``place(image, count, generator)`` returns means (count, 2) in pixels and factors (count, 3) for
an image (H, W, C)."""

PLACEMENTS: dict[str, Placement] = {
    "grid": place_grid,
    "random": place_random,
}
"""Placements by the name that ``init`` takes; each name stands in
`eigengs_dr.fitting.options.INITS` too."""


def initialize(pixels: NDArray[np.float32], options: FitOptions) -> FitProblem:
    """Place Gaussians and find their colours before refinement.

    Parameters
    ----------
    pixels : ndarray of float32, shape (H, W, C)
        Pixels from `eigengs_dr.fitting.target.read_pixels`.
    options : FitOptions

    Returns
    -------
    FitProblem

    Raises
    ------
    ValueError
        If the start contradicts another option.
    TypeError
        If the start is something else.
    """
    return start_for(make_target(pixels, options.space), options)


def start_for(target: FitTarget, options: FitOptions) -> FitProblem:
    """Place Gaussians for a target and find their colours; see `initialize`."""
    if options.start is None:
        return start_from_placement(target, options)
    return start_from_set(target, options)


def start_from_set(target: FitTarget, options: FitOptions) -> FitProblem:
    """Take the Gaussians of a set or of a model, at the size of the image."""
    method, source = options.method, load_start(options.start, options.backend)
    height, width = target.values.shape[:2]
    native = source if isinstance(source, Gaussians) else source.gaussians
    check_start(native, target.values, options)
    if isinstance(source, Gaussians):
        start, exact = source.scaled(width, height), False
    else:
        colors = "exact" if method.solves else "projected"
        start = source.encode(target.pixels, colors, method.mean)
        # At another size or cutoff the colours of a model are not exact.
        exact = (native.width, native.height, native.cutoff) == (width, height, options.cutoff)
    start = replace(start, cutoff=float(options.cutoff))
    if options.iterations:  # a descent needs means inside of the image
        start = start.bounded()
    if method.solves and not exact:
        start = solve(start, target.values, options.solve_steps, warm_start=True)
    if method.mean != "dense":
        return FitProblem(start, target.values, target.weight, control_for(target, options))
    assert not isinstance(source, Gaussians)
    return FitProblem(start, target.values - source.dense_mean(width, height), target.weight)


def load_start(start: Any, backend: str | None) -> Gaussians | Model:
    """Return the set or the model of a start, without the derivatives of the caller.

    Raises
    ------
    ValueError
        If the set is on another backend, or its file is none.
    TypeError
        If the start is something else.
    """
    if isinstance(start, (str, os.PathLike)):
        return one_image(Gaussians.load(start, backend))
    found = start if isinstance(start, Model) else dr.detach(one_image(set_of(start)))
    current = types_of((found if isinstance(found, Gaussians) else found.gaussians).mean).backend
    if backend not in (None, current):
        raise ValueError(
            f"the start is on backend {current!r}, not on {backend!r}; load it with "
            f"backend={backend!r}, or leave the backend out"
        )
    return found


def check_start(start: Gaussians, values: NDArray[np.float32], options: FitOptions) -> None:
    """Raise ValueError unless a start fits the image (H, W, C) and the options."""
    count, (height, width, channels) = len(start), values.shape
    if options.gaussians not in (None, count):
        raise ValueError(
            f"gaussians is {options.gaussians}, but the start has {count}; leave the number or "
            "the start out"
        )
    if count > width * height:
        raise ValueError(
            f"the start has {count} Gaussians, more than an image of {width}x{height} has pixels; "
            "use init 'adaptive'"
        )
    if options.space != start.space:
        raise ValueError(
            f"space is {options.space!r}, but the start is in {start.space!r}; use space "
            f"{start.space!r}, or another start"
        )
    if channels != start.channels:
        raise ValueError(
            f"the image has {channels} channels, but the start has {start.channels}; use another "
            "start"
        )


def mean_picture(options: FitOptions, width: int, height: int) -> NDArray[np.float32] | None:
    """Return the RGB that a fit adds to renderings of its set, (height, width, 3), or None.

    It is the mean image of the model, if the method keeps the mean image as pixels; a rendering
    already holds the RGB of zeros.
    """
    if options.method.mean != "dense" or not isinstance(options.start, Model):
        return None
    planes = options.start.dense_mean(width, height)
    rgb = np.stack(decode(options.space, list(np.moveaxis(planes, 2, 0))), axis=2)
    return rgb - np.array(decode(options.space, [0.0] * planes.shape[2]), np.float32)


def start_from_placement(target: FitTarget, options: FitOptions) -> FitProblem:
    """Place Gaussians by the image alone, and find their colours."""
    start = place(target, options)
    if options.method.solves:
        start = solve(start, target.values, options.solve_steps)
    return FitProblem(start, target.values, target.weight, control_for(target, options))


def place(target: FitTarget, options: FitOptions) -> Gaussians:
    """Place Gaussians by the image alone, with the colour 0, or by chance if none is solved for.

    A batch gets the sets of all images, image after image.
    """
    values = target.values if target.values.ndim == 4 else target.values[None]
    images, height, width, channels = values.shape
    count = options.count_for(values[0])
    if options.placement == "adaptive":
        return place_adaptive(
            target.shown, count, options.space, options.backend, float(options.cutoff)
        )
    generator = np.random.default_rng(options.seed)
    mean, factor = PLACEMENTS[str(options.placement)](values[0], count, generator)
    color: NDArray[np.floating] = np.zeros((count, channels), np.float32)
    if not options.method.solves:
        color = generator.uniform(0, 1, color.shape)
    return Gaussians.from_arrays(
        *(np.tile(rows, (images, 1)) for rows in (mean, factor, color)),
        size=(width, height),
        space=options.space,
        backend=options.backend,
        cutoff=options.cutoff,
    ).bounded()


def control_for(target: FitTarget, options: FitOptions) -> DensityControl:
    """Return the density control of a fit: every start may relocate.

    Means over 6 training photos of 192 x 192 pixels after 1,000 steps, psnr_rgb without and with
    relocation: 28.3 and 31.3 dB from a grid, 27.1 and 31.2 dB from random places (1,800 Gaussians),
    36.0 and 40.1 dB from a model (5,000).
    """
    anew = options.placement == "adaptive"
    return DensityControl(target.values, target.weight, target.shown, options.solve_steps, anew)

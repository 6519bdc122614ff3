"""The start of a fit: Gaussians with colours, placed by the image alone or by a basis."""

from __future__ import annotations

from collections.abc import Callable
from pkgutil import resolve_name

import numpy as np
from numpy.typing import NDArray

from ..gaussian.gaussians import Gaussians
from .density_control import DensityControl
from .descent import FitProblem
from .options import FitOptions
from .placement.adaptive import place_adaptive
from .placement.uniform import place_grid, place_random
from .solvers.conjugate_gradient import solve
from .target import FitTarget, make_target

Placement = Callable[
    [NDArray[np.floating], int, np.random.Generator],
    tuple[NDArray[np.float64], NDArray[np.float64]],
]
"""``place(image, count, generator)`` returns means (count, 2) in pixels and factors (count, 3) for
an image (H, W, C)."""

PLACEMENTS: dict[str, Placement] = {
    "adaptive": place_adaptive,
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
        If the basis contradicts another option.
    """
    target = make_target(pixels, options.space)
    if options.initializer == "eigen":
        start = resolve_name("eigengs_dr.eigenbasis.initializer:start_from_basis")
        problem: FitProblem = start(target, options)
        return problem
    return start_from_placement(target, options)


def start_from_placement(target: FitTarget, options: FitOptions) -> FitProblem:
    """Place Gaussians by the image alone, and find their colours."""
    method, count = options.method, options.count_for(target.values)
    height, width, channels = target.values.shape
    generator = np.random.default_rng(options.seed)
    mean, factor = PLACEMENTS[options.initializer](target.shown, count, generator)
    color: NDArray[np.floating] = np.zeros((count, channels), np.float32)
    if not method.solves:
        color = generator.uniform(0, 1, color.shape)
    start = Gaussians.from_arrays(
        mean,
        factor,
        color,
        size=(width, height),
        space=options.space,
        backend=options.backend,
        cutoff=options.cutoff,
    ).bounded()
    if method.solves:
        start = solve(start, target.values, options.solve_steps).gaussians
    return FitProblem(start, target.values, target.weight, control_for(target, options))


def control_for(target: FitTarget, options: FitOptions) -> DensityControl:
    """Return the density control of a fit: every start may relocate.

    Means over 6 training photos of 192 x 192 pixels after 1,000 steps, psnr_rgb without and with
    relocation: 28.3 and 31.3 dB from a grid, 27.1 and 31.2 dB from random places (1,800 Gaussians),
    36.0 and 40.1 dB from an eigenbasis (5,000).
    """
    anew = options.initializer == "adaptive"
    return DensityControl(target.values, target.weight, target.shown, options.solve_steps, anew)

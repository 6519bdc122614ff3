"""The start of a fit from a placement by the image alone."""

from __future__ import annotations

from functools import partial
from pkgutil import resolve_name

import numpy as np

from ..gaussian.gaussians import Gaussians
from .density_control import relocate
from .initializers import PLACEMENTS, FitProblem, FitTarget, Placement
from .options import FitOptions
from .redistribute import redistribute
from .solvers.conjugate_gradient import solve


def start_from_placement(target: FitTarget, options: FitOptions) -> FitProblem:
    """Place Gaussians by the image alone; see `eigengs_dr.fitting.initializers.Initializer`."""
    name, method = options.initializer, options.method
    place: Placement = resolve_name(PLACEMENTS[name])
    shown = target.values if target.shown is None else target.shown
    count = options.count_for(target.values)
    generator = np.random.default_rng(options.seed)
    mean, factor = place(shown, count, generator)
    shape = (count, target.values.shape[2])
    start = Gaussians.from_arrays(
        mean,
        factor,
        np.zeros(shape, np.float32) if method.solves else generator.uniform(0, 1, shape),
        size=(target.values.shape[1], target.values.shape[0]),
        space=options.space,
        backend=options.backend,
        cutoff=options.cutoff,
    ).bounded()
    if not method.solves:
        return FitProblem(start, target.values, target.weight)
    solved = solve(start, target.values, options.solve_steps).gaussians
    again = partial(
        redistribute,
        image=shown,
        target=target.values,
        weight=target.weight,
        solve_steps=options.solve_steps,
    )
    anew = again if name == "adaptive" else None
    moves = partial(relocate, target=target.values, weight=target.weight)
    return FitProblem(
        solved, target.values, target.weight, redistribute=anew, relocate=moves if anew else None
    )

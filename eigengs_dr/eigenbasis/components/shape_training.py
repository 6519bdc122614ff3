"""Training of the shapes on random combinations of all components.

With ``r_j ~ N(0, 1)``, ``sum_j r_j sqrt(lambda_j) Psi_j`` is a sample of the PCA model. The r_j are
independent, so the expected squared error of the rendered sample is ``sum_j lambda_j |Psi~_j -
Psi_j|^2``. One rendering therefore gives an unbiased estimate of the error of the full basis. Each
step first solves for the colours; at their optimum, the total derivative with respect to the shapes
equals the partial derivative (variable projection).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import drjit as dr
import numpy as np

from ...backend.arrays import types_of
from ...backend.recording import freeze_program
from ...fitting.descent import begin, pack, rate_table, started, step_program
from ...fitting.method import Method
from ...fitting.objective import Pixels
from ...fitting.optimizer import Adam
from ...fitting.place import Grid
from ...fitting.solve import solve
from ...fitting.variables import Relative
from ...gaussian.gaussians import Gaussians
from ...raster.render import bin_gaussians
from .bands import FrequencyBand, Planes, State, on_grid, shapes_of

RESTART_STEPS = 25
"""Number of steps between two restarts of the optimiser; a checkpoint at a restart only needs the
shapes."""

SOLVE_STEPS = 30
"""Number of conjugate gradient steps for the colours of a sample. With 8 steps, the derivative has
an error of a third."""

SHAPES = Method(
    place=Grid(),
    controls=(),
    optimizer=Adam(0.9, 0.99, 1e-12),
    rates={"mean": 0.02, "factor": 0.02},
    coordinates=Relative(),
)
"""The method of the descent. The learning rates are a sixth of those for one image, because every
step uses a new sample."""


def train_shapes(
    band: FrequencyBand,
    seed: int,
    steps: int,
    backend: str | None = None,
    state: State | None = None,
) -> Iterator[State]:
    """Train the means and factors of Gaussians, initialized on a grid, to render all components.

    Parameters
    ----------
    band : FrequencyBand
    seed : int
        Seed of the random combinations; seed and step determine a combination.
    steps : int
        Total number of steps; 0 keeps the grid.
    backend : {"llvm", "cuda"}, optional
    state : dict, optional
        Resume from this earlier state, as if the training had not been interrupted.

    Yields
    ------
    dict of str to ndarray
        "step", "mean" and "factor", at the start, after every `RESTART_STEPS` steps and at the end.
    """
    if state is None:
        state = on_grid(band)
        yield state
    if not any(map(len, band.components)):
        return
    gaussians = shapes_of(state, band, backend)
    for first in range(int(state["step"]), steps, RESTART_STEPS):
        last = min(first + RESTART_STEPS, steps)
        gaussians = _round(gaussians, band, seed, (first, last, steps))
        arrays = gaussians.to_arrays()
        yield {"step": np.array(last), "mean": arrays["mean"], "factor": arrays["factor"]}


def _round(
    gaussians: Gaussians, band: FrequencyBand, seed: int, span: tuple[int, int, int]
) -> Gaussians:
    """Take the steps ``[first, last)`` of a span, with a new optimiser."""
    first, last, steps = span
    state, types = started(begin(gaussians), SHAPES, first), types_of(gaussians.mean)
    rates = rate_table(types, SHAPES, SHAPES.rate_factors(steps))
    images = samples(band, seed, first, last)
    with freeze_program(step_program(Pixels.plain(images[0], gaussians), SHAPES)) as take_step:
        moving, current = state.moving, gaussians
        assert moving is not None
        for step, image in enumerate(images, first):
            objective = Pixels.plain(image, gaussians)
            solved = solve(current, objective, SOLVE_STEPS)
            fixed = replace(gaussians, color=solved.color, background=solved.background)
            moving, current = take_step(
                len(gaussians),
                moving._replace(packed=pack(solved)),
                fixed,
                objective.model,
                [bin_gaussians(solved)],
                rates,
                dr.opaque(types.UInt, step),
            )
    return dr.detach(current)


def samples(band: FrequencyBand, seed: int, first: int, last: int) -> Planes:
    """Draw random combinations of the components, without the mean image.

    Returns
    -------
    ndarray of float32, shape (last - first, H, W, C)
        Combination i depends only on `seed` and ``first + i``.
    """
    channels = []
    for c, (planes, values) in enumerate(zip(band.components, band.eigenvalues, strict=True)):
        r = [
            np.random.default_rng([seed, i, c]).normal(size=len(planes)) for i in range(first, last)
        ]
        coefficients = (np.stack(r) * np.sqrt(values)).astype(np.float32)
        channels.append(np.tensordot(coefficients, planes, axes=1))
    return np.stack(channels, axis=3)

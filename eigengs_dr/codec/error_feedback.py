"""Rounding with error feedback: later parameters compensate for the rounding of earlier ones.

Rounding takes three stages. Round the shapes, then descend on means and colours. Round the means,
then solve for the colours. Round every other colour, then solve for the rest. At equal error, the
descent makes files 4 % smaller, and the alternate rounding 1 to 2 %, than one solve for the
colours. A set in several sections gets no compensation, because a reader may stop after any
section.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import types_of
from ..fitting.initializers import FitProblem
from ..fitting.optimizers.descent import descend
from ..fitting.presets import PRESETS
from ..fitting.solvers.conjugate_gradient import solve
from ..gaussian.covariance import log_shapes
from ..gaussian.gaussians import Gaussians
from ..raster.render import render
from .egs import EgsContent
from .quantization import Steps, dequantize, quantize

Array = NDArray[np.floating]

COMPENSATION_STEPS = 20
"""Steps of the descent on means and colours after the rounding of the shapes."""

COMPENSATION_RATE = 0.4
"""Learning rates of this descent, as a fraction of those of `fit`: the optimum is near."""


def quantize_with_feedback(
    gaussians: Gaussians, target: Array, steps: Steps, rows: list[slice]
) -> EgsContent:
    """Round shapes, then means, then colours; let the parameters not yet rounded compensate.

    Parameters
    ----------
    gaussians : Gaussians
        Set without gradients.
    target : ndarray, shape (H, W, C)
        Target of the rendering, in the space of the set.
    steps : Steps
    rows : list of slice
        Range of the Gaussians of each section.

    Returns
    -------
    EgsContent

    Raises
    ------
    ValueError
        If a number would be too large to store.
    """
    arrays = gaussians.to_arrays()
    shape = log_shapes(arrays["factor"])
    if len(rows) == 1:  # compensation for the whole set would harm its prefixes
        arrays |= _compensate(gaussians, target, shape, steps)
    symbols = quantize(arrays["mean"], shape, arrays["color"], steps)
    background, size = arrays["background"], (gaussians.width, gaussians.height)
    return EgsContent(
        [symbols.select(r) for r in rows],
        steps,
        background,
        size,
        gaussians.space,
        gaussians.cutoff,
    )


def _compensate(
    gaussians: Gaussians, target: Array, shape: Array, steps: Steps
) -> dict[str, Array]:
    """Return means, colours and background that compensate for the rounding."""
    arrays, none = gaussians.to_arrays(), np.zeros((len(gaussians), gaussians.channels))
    fixed = dequantize(quantize(arrays["mean"], shape, none, steps), steps)
    current = _with(gaussians, factor=fixed["factor"])
    if _all_inside(gaussians):  # descent would move means outside the image into it
        current = solve(current, target, 5, warm_start=True).gaussians
        schedule = PRESETS["default"].schedule
        rates = {name: COMPENSATION_RATE * schedule.rates[name] for name in ("mean", "color")}
        slow = replace(schedule, rates=rates)
        problem = FitProblem(current, target.astype(np.float32))
        *_, current = descend(problem, slow, COMPENSATION_STEPS)
    mean = current.to_arrays()["mean"]
    fixed = dequantize(quantize(mean, shape, none, steps), steps)
    current = _with(current, mean=fixed["mean"])
    solved = solve(current, target, 10, warm_start=True).gaussians
    arrays = _round_alternately(solved, target, mean, shape, steps).to_arrays()
    return {"mean": mean, "color": arrays["color"], "background": arrays["background"]}


def _round_alternately(
    solved: Gaussians, target: Array, mean: Array, shape: Array, steps: Steps
) -> Gaussians:
    """Round every other colour; solve for the colours between, which are near in space."""
    if len(solved) == 1:
        return solved
    arrays, late = solved.to_arrays(), np.arange(len(solved)) % 2 == 1
    rough = dequantize(quantize(mean, shape, arrays["color"], steps), steps)["color"]
    kept = _with(solved, color=rough, background=0 * arrays["background"])[~late]
    kept = replace(kept, space="data")
    rest = target - render(kept).numpy()
    found = solve(solved[late], rest, 5, warm_start=True).gaussians.to_arrays()
    rough[late] = found["color"]
    return _with(solved, color=rough, background=found["background"])


def to_gaussians(packed: EgsContent, like: Gaussians) -> Gaussians:
    """Return the Gaussians of a content, on the backend of another set."""
    backend = types_of(like.mean).backend
    return Gaussians.from_arrays(
        **packed.arrays(),
        size=packed.size,
        space=packed.space,
        backend=backend,
        cutoff=packed.cutoff,
    )


def _with(gaussians: Gaussians, **changed: Array) -> Gaussians:
    """Return the set with some arrays replaced."""
    return Gaussians.from_arrays(
        **{**gaussians.to_arrays(), **changed},
        size=(gaussians.width, gaussians.height),
        space=gaussians.space,
        backend=types_of(gaussians.mean).backend,
        cutoff=gaussians.cutoff,
    )


def _all_inside(gaussians: Gaussians) -> bool:
    """Return whether all means lie in the image."""
    mean = gaussians.to_arrays()["mean"]
    return bool(((mean >= 0) & (mean <= (gaussians.width, gaussians.height))).all())

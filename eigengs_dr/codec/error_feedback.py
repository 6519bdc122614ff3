"""Round a set of Gaussians so that what is rounded later makes up for what was lost before.

Shapes are rounded first, and means and colours descend; then means, and colours are solved for;
then half of the colours, and the others are solved for again. At equal error files are 4 % smaller
for the descent, and 1 to 2 % for the halves, than with colours solved for once. In several sections
all is rounded as it is: a reader may stop after each of them.
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
"""Steps that means and colours take after the shapes are rounded."""

COMPENSATION_RATE = 0.4
"""Their rates, as a share of those of `fit`: they are not far from where they should be."""


def quantize_with_feedback(
    gaussians: Gaussians, target: Array, steps: Steps, rows: list[slice]
) -> EgsContent:
    """Round shapes, then means, then colours, each time with the best of what is still free.

    Parameters
    ----------
    gaussians : Gaussians
        Detached.
    target : ndarray, shape (H, W, C)
        What its channels, as they are, shall render to.
    steps : Steps
    rows : list of slice
        The splats of each section.

    Raises
    ------
    ValueError
        If a number would be too large to be stored.
    """
    arrays = gaussians.to_arrays()
    shape = log_shapes(arrays["factor"])
    if len(rows) == 1:  # what makes up for the whole does not for the first splats alone
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
    """Means, colours and background that make up for what the rounding of others loses."""
    arrays, none = gaussians.to_arrays(), np.zeros((len(gaussians), gaussians.channels))
    fixed = dequantize(quantize(arrays["mean"], shape, none, steps), steps)
    current = _with(gaussians, factor=fixed["factor"])
    if _all_inside(gaussians):  # descent would move splats that lie outside into the image
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
    """Round every other colour: those between, neighbours in space, make up for what is lost."""
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
    """Return the splats of a file before it is written, on the backend of another set."""
    backend = types_of(like.mean).backend
    return Gaussians.from_arrays(
        **packed.arrays(),
        size=packed.size,
        space=packed.space,
        backend=backend,
        cutoff=packed.cutoff,
    )


def _with(gaussians: Gaussians, **changed: Array) -> Gaussians:
    """The set with other arrays."""
    return Gaussians.from_arrays(
        **{**gaussians.to_arrays(), **changed},
        size=(gaussians.width, gaussians.height),
        space=gaussians.space,
        backend=types_of(gaussians.mean).backend,
        cutoff=gaussians.cutoff,
    )


def _all_inside(gaussians: Gaussians) -> bool:
    """Whether all means lie in the image."""
    mean = gaussians.to_arrays()["mean"]
    return bool(((mean >= 0) & (mean <= (gaussians.width, gaussians.height))).all())

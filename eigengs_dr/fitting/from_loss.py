"""A fit of a loss without an image: texels, then Gaussians."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.types import Float
from ..gaussian.gaussians import Gaussians
from ..raster.render import to_tensor
from .channels import Measured, Row
from .coarse import Coarse, texel_sums
from .loop import Descent, FitProgress, Refinement, descend, last, refine
from .loss import PictureLoss
from .method import DEFAULT
from .objective import Objective, Pixels
from .place import Adaptive
from .problem import Problem
from .search import search_count
from .state import begin

PIXELS_PER_GAUSSIAN = 4
"""Pixels of the picture per Gaussian, if nothing indicates how many the scene needs. With 16, a fit
loses detail that photos show, and takes hardly less time."""

SEEN_PER_GAUSSIAN = 3
"""Pixels that a loss looks at, per Gaussian, if it says their number: with two photos of 256x256
pixels of a painting of 1024x1024 texels, one for 24 texels is 0.3 dB better than one for 4, and its
texture 1.1 dB."""

STEPS_PER_TEXEL = 8
"""Steps of a fit of the texels' picture for each texel of a Gaussian: Gaussians of 4 texels show it
after 30 steps, and those of 64 need 150."""


def fit_loss(
    problem: Problem,
    started: float,
    progress: FitProgress | None,
    interrupted: Callable[[], bool],
) -> tuple[Refinement, float]:
    """Descend on a loss from nothing or from a set; also return the seconds before Gaussians move.

    A pyramid of texels takes the first steps, see `Coarse`. Gaussians are fitted to its picture,
    and take the remaining steps, in which a search finds the fewest for a target. For the arguments
    see `eigengs_dr.fitting.fit.fit_problem` and `Descent`.
    """

    def seconds() -> dict[str, float]:
        return {"seconds": time.perf_counter() - started}

    def show(step: int) -> None:
        if step % 10 == 0 and progress:
            dr.sync_thread()
            progress(step, options.iterations, seconds())
        if interrupted():
            raise KeyboardInterrupt

    options, taken, stopped, trace = problem.options, 0, False, list[Row]()
    loss = problem.picture_loss()
    assert loss is not None
    if problem.start is None:
        place = options.method.place
        coarse = place if isinstance(place, Coarse) else Coarse()
        sums, stopped = _descend_texels(problem, loss, coarse, show)
        image, taken = _image(problem, sums.numpy()), loss.calls.step
        try:
            if loss.is_called_by_row:
                value = loss.judge(loss.seen(image.picture(image.model.target).array))
            else:
                value = loss.calls.recent()
            trace = [{**seconds(), "iteration": taken, "loss": value}]
        except KeyboardInterrupt:
            stopped = True
        start = _start(image, problem, coarse)
    else:
        start = _set_for(problem)
        image = _image(problem, to_tensor(loss.draw_set(start)[0], loss.grid, loss.number).numpy())
    seconds_init = time.perf_counter() - started

    def score(gaussians: Gaussians) -> list[Measured]:
        exact = loss.is_called_by_row or loss.calls.step == options.iterations
        row = loss.judged(gaussians) if exact else {"loss": loss.calls.recent()}
        return [Measured({**seconds(), **row}, row.get("margin", math.inf))]

    descent = Descent(
        Objective(image, loss),
        options.method,
        score,
        options.seed,
        progress and (lambda step, steps, row: progress(step + taken, options.iterations, row)),
        lambda: stopped or interrupted(),
    )
    steps = options.iterations - taken
    if options.searches:
        refined = search_count(descent, start, problem.max_count, steps)
    else:
        # The start is the choice of the user.
        method = descent.method.without("densify", "redistribute")
        [refined] = refine(replace(descent, method=method), begin(start), steps)
    if refined.stopped != "interrupted":
        loss.calls.check_use()
    trace += [{**row, "iteration": row["iteration"] + taken} for row in refined.trace]
    return replace(refined, trace=trace, iterations=refined.iterations + taken), seconds_init


def _set_for(problem: Problem) -> Gaussians:
    """Return the set to start from, at the size and the cutoff of the fit."""
    start, cutoff = problem.start, float(problem.options.method.cutoff)
    assert isinstance(start, Gaussians)
    return replace(start.scaled(*problem.size), cutoff=cutoff, maps=()).bounded()


def _image(problem: Problem, values: NDArray[np.floating]) -> Pixels:
    """Return the squared error of a picture of these sums, (H * W * C,)."""
    space, (width, height) = problem.space, problem.size
    values = np.asarray(values, np.float32).reshape(height, width, problem.number)
    values = np.maximum(values, 0) if space.is_light else values
    placed = space.placement_image(values)
    return Pixels.of(values, space, problem.types, problem.weight, placed)


def _descend_texels(
    problem: Problem, loss: PictureLoss, coarse: Coarse, progress: Callable[[int], None]
) -> tuple[Float, bool]:
    """Return the sums that texels reach, as rows of pixels, and whether the user ended the fit."""
    steps = min(coarse.max_steps, round(coarse.share * problem.options.iterations))
    reach = min(channels.space.reach for channels in problem.channels)
    low, high = loss.loss.bounds or (0.0, reach)
    middle = loss.loss.bounds or (0.0, 1.0)
    grey = np.concatenate([c.space.grey(*middle, c.number) for c in problem.channels])
    states = texel_sums(problem.types, loss, coarse, steps, grey.tolist(), high - low)
    with closing(states):
        try:
            for step, sums in enumerate(states):  # noqa: B007
                progress(step)
        except KeyboardInterrupt:
            return sums, True
    return sums, False


def _start(image: Pixels, problem: Problem, coarse: Coarse) -> Gaussians:
    """Fit Gaussians to the picture of texels."""
    options = problem.options
    assert options.loss is not None
    pixels = problem.size[0] * problem.size[1]
    method = replace(DEFAULT, place=options.method.place, cutoff=options.method.cutoff)
    if not isinstance(method.place, Adaptive):  # the choice of a placement is not undone
        method = method.without("densify", "redistribute")
    count = pixels // PIXELS_PER_GAUSSIAN
    if options.loss.pixels is not None:
        count = min(count, options.loss.pixels // SEEN_PER_GAUSSIAN)
    start = method.place_and_solve(image, options.count or max(1, count), options.seed)
    steps = min(coarse.fit_steps, STEPS_PER_TEXEL * pixels // len(start))
    return last(descend(Objective(image), method, begin(start), steps, options.seed), start)

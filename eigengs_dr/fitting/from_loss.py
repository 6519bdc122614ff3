"""A fit of a loss without an image: texels, then the number of Gaussians, then the Gaussians."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, replace
from typing import TypeAlias

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import ArrayTypes
from ..backend.types import Float
from ..gaussian.channels import TextureMap, check_maps, slices
from ..gaussian.gaussians import Gaussians
from ..image.space import DATA, YCBCR, space_of
from ..storage.npz import BadValue
from .coarse import Coarse, texel_sums
from .loop import FitProgress, Refinement, descend, last, refine
from .loss import Loss, LossObjective, View
from .measure import Row
from .method import DEFAULT
from .objective import Data, Pixels
from .options import FitOptions, max_gaussians_for
from .state import begin

Spaces: TypeAlias = "str | Mapping[str, str] | None"
"""The space of a picture, or those of several maps by name; data have one channel."""

MayEnd: TypeAlias = Callable[[], AbstractContextManager[None]]
"""A block in which a function of the user may end the fit by a `KeyboardInterrupt`."""

PIXELS_PER_GAUSSIAN = 16
"""Pixels of the picture per Gaussian, if nothing indicates how many the scene needs. On the scenes
of ``bench inverse`` with the photo "coffee", it ends within 0.4 dB of the best number."""

FIRST_PIXELS = 128
"""Pixels of the picture per Gaussian, for the smallest number that a judge tries."""


def views_of_spaces(spaces: Spaces) -> tuple[list[View], tuple[TextureMap, ...]]:
    """Return what the channels of a set show, and the maps of the set.

    Raises
    ------
    ValueError
        If a space or a name is invalid.
    """
    named = spaces if isinstance(spaces, Mapping) else {"": spaces or YCBCR}
    known = {name: space_of(space) for name, space in named.items()}
    maps = tuple(TextureMap(name, s, 1 if s.by_range else 3) for name, s in known.items())
    if isinstance(spaces, Mapping):
        try:
            check_maps(maps, sum(m.channels for m in maps))
        except BadValue as error:
            raise ValueError(str(error)) from None
    views = [
        View(m.name, m.space, range(channels.start, channels.stop))
        for m, channels in zip(maps, slices(maps), strict=True)
    ]
    return views, maps if isinstance(spaces, Mapping) else ()


@dataclass(frozen=True)
class Problem:
    """A loss for a picture that is still unknown.

    Attributes
    ----------
    loss : Loss
    size : (int, int)
        Width and height in pixels.
    views : list of View
    types : ArrayTypes
        Backend and precision of the sets.
    weight : ndarray of float32, shape (H, W) or (H, W, C), or None
        How much each pixel matters.
    """

    loss: Loss
    size: tuple[int, int]
    views: list[View]
    types: ArrayTypes
    weight: NDArray[np.float32] | None = None

    @property
    def channels(self) -> int:
        """Number of channels of a set."""
        return sum(len(view.channels) for view in self.views)

    def near(self, values: NDArray[np.floating]) -> LossObjective:
        """Return the objective of a loss whose best picture is near these sums, (H * W * C,)."""
        space = DATA if self.views[0].name else self.views[0].space
        width, height = self.size
        values = np.asarray(values, np.float32).reshape(height, width, self.channels)
        values = np.maximum(values, 0) if space.is_light else values
        image = space.placement_image(values)
        pixels = Pixels.of(Data(values, image, self.weight), space, self.types)
        return LossObjective.of_loss(self.loss, self.views, pixels)

    def grey(self) -> NDArray[np.floating]:
        """Return the sums of a pixel that is still unknown, shape (C,)."""
        low, high = self.loss.bounds or (0.0, 1.0)
        return np.concatenate([v.space.grey(low, high, len(v.channels)) for v in self.views])


def refine_loss(
    problem: Problem,
    options: FitOptions,
    start: Gaussians | None,
    started: float,
    progress: FitProgress | None,
    interrupted: Callable[[], bool],
) -> tuple[Refinement, float]:
    """Descend on a loss from nothing or from a set; also return the seconds before Gaussians move.

    A pyramid of texels takes the first steps, see `Coarse`. Gaussians are fitted to its picture: a
    given number, or numbers that double while the loss gains from it. They take the remaining
    steps.
    """
    stopped = False

    @contextmanager
    def may_end() -> Iterator[None]:
        """Let a function of the user end the fit by a `KeyboardInterrupt`."""
        nonlocal stopped
        try:
            yield
        except KeyboardInterrupt:
            stopped = True

    def show(step: int, row: Row) -> None:
        if progress and not stopped:
            with may_end():
                progress(step, options.iterations, row)

    def timed(row: Row) -> Row:
        return {"seconds": time.perf_counter() - started, **row}

    def ended(step: int = 1) -> bool:
        if step % 10 == 0:
            dr.sync_thread()
            show(step, timed({}))
        return stopped or interrupted()

    steps_taken, trace = 0, []
    if start is None:
        place = options.method.place
        coarse = place if isinstance(place, Coarse) else Coarse()
        steps = round(coarse.share * options.iterations)
        objective = _descend_texels(problem, coarse, steps, ended, may_end)
        steps_taken = objective.calls.step
        with may_end():
            trace = [{"loss": objective.judge(objective.seen(_rows(objective)))}]
        start, numbers = _start(objective, options, coarse, ended, may_end)
        trace = [timed({"iteration": steps_taken, **row}) for row in trace + numbers]
    else:
        objective = problem.near(np.zeros(problem.size[0] * problem.size[1] * problem.channels))
        sums = objective.picture(objective.draw_set(start)[0])
        objective = problem.near(sums.numpy())
    seconds_init = time.perf_counter() - started
    refined = refine(
        objective,
        options.method,
        begin(start, chosen=True),
        options.iterations - steps_taken,
        lambda gaussians: [timed(objective.judged(gaussians))],
        options.seed,
        progress and (lambda step, steps, row: show(step + steps_taken, row)),
        ended,
    )[0]
    if refined.stopped != "interrupted":
        objective.calls.check_use()
    rows = [{**row, "iteration": row["iteration"] + steps_taken} for row in refined.trace]
    refinement = replace(refined, trace=trace + rows, iterations=refined.iterations + steps_taken)
    return refinement, seconds_init


def _rows(objective: LossObjective) -> Float:
    """Return the picture near which a loss is least, as rows of pixels."""
    assert objective.model.target is not None
    return objective.picture(objective.model.target).array


def _descend_texels(
    problem: Problem, coarse: Coarse, steps: int, ended: Callable[[int], bool], may_end: MayEnd
) -> LossObjective:
    """Return the objective of a loss near the picture of a pyramid of texels."""
    reach = min(view.space.reach for view in problem.views)
    grey, (low, high) = problem.grey(), problem.loss.bounds or (0.0, reach)
    objective = problem.near(np.tile(grey, problem.size[0] * problem.size[1]))
    states = texel_sums(objective, coarse, steps, grey.tolist(), high - low)
    with closing(states), may_end():
        for step, sums in enumerate(states):  # noqa: B007
            if ended(step):
                break
    return replace(problem.near(sums.numpy()), calls=objective.calls)


def _start(
    objective: LossObjective,
    options: FitOptions,
    coarse: Coarse,
    ended: Callable[[], bool],
    may_end: MayEnd,
) -> tuple[Gaussians, list[Row]]:
    """Fit Gaussians to the image of an objective; also return rows for the numbers tried."""
    width, height = objective.size
    image = objective.image()
    method = replace(DEFAULT, cutoff=options.method.cutoff)

    def fitted(count: int) -> Gaussians:
        start = method.place_and_solve(image, count, options.seed)
        states = descend(image, method, begin(start), coarse.fit_steps, options.seed)
        return last(states, start)

    loss, pixels = objective.loss, width * height
    if options.gaussians is not None or (loss.judge is None and loss.target is None):
        return fitted(options.count or max(1, pixels // PIXELS_PER_GAUSSIAN)), []
    max_count, count = max_gaussians_for(pixels, objective.channels), pixels // FIRST_PIXELS
    best, rows = fitted(max(1, count)), []
    gaussians = best
    with may_end():
        while True:
            rows.append({"gaussians": len(gaussians), **objective.judged(gaussians)})
            if len(rows) > 1 and rows[-1]["loss"] >= rows[-2]["loss"]:
                break
            best, count = gaussians, 2 * max(1, count)
            if loss.target is not None and rows[-1]["loss"] <= loss.target:
                break
            if count > max_count or ended():
                break
            gaussians = fitted(count)
    return best, rows

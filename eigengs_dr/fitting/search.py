"""The fewest splats for a quality.

Three stages. *Estimate*: some steps with few splats tell what more would reach, two tries what
twice as many gain, and each where the splats of the next one belong
(`eigengs_dr.fitting.redistribute`). *Fit* that number. *Settle*: drop what is worth least while the
goal is met, add where the error is while it is not (`eigengs_dr.fitting.density_control`), each
time with a short descent.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import drjit as dr

from ..gaussian.gaussians import Gaussians
from ..raster.render import CUTOFF
from .density_control import densify, prune
from .initializers import FitProblem
from .optimizers.descent import descend
from .optimizers.schedule import Schedule
from .refine import FitProgress, Refinement

TRY, FIT, SETTLE = 0.1, 0.4, 0.12
"""Shares of the iterations that a try takes, the fit, and each descent that settles."""

LENGTH = 2
"""Times the iterations that a search takes at most, if these are not few (some ten)."""

TRIES, SETTLING = 4, 5
"""Most tries, and descents to settle after which a goal that is met is settled enough."""

OCTAVE = 4.0
"""Decibels that twice as many splats gain, see
`eigengs_dr.fitting.placement.density.ERROR_EXPONENT`, until
two
tries of this image tell it."""

SLOPES = (2.0, 12.0)
"""Fewest and most of them that are believed; a training image gained 8, another 1.6."""

APART = 0.25
"""Octaves between two tries that tell it."""

TO_COME = 0.25
"""What a fit gains after the steps of a try, as a share of what it gained in them: measured with
150 to 2,500 splats on training images of ImageNet classes, to half a decibel."""

AIM = 1.09
"""Times the splats of the estimate that are fitted: dropping some settles it better than adding."""

LEAP = 16
"""Largest factor from one try to the next."""

CLOSE, FAR = 0.1, 0.35
"""Shares by which the last try, and the fit, may miss the number that they tell."""

DROP = 0.15
"""Largest share of the splats that are dropped at once."""

GENTLE = 0.3
"""Share of the rates in a descent that settles."""

GAIN = 0.1
"""Decibels that the first of them is believed to gain; on training images it gained 0.2."""

AGAIN = 0.5
"""Share of what a descent that settles gained, which the next one is believed to gain again."""

SURPLUS = 0.02
"""Decibels above the goal that are not worth another descent."""

Row = dict[str, Any]


def search_count(
    start: FitProblem,
    measure: Callable[[Gaussians], Row],
    figure: str,
    goal: float,
    most: int,
    schedule: Schedule,
    iterations: int = 1000,
    cutoff: float = CUTOFF,
    progress: FitProgress | None = None,
    interrupted: Callable[[], bool] = lambda: False,
) -> Refinement:
    """Find the fewest splats that meet a goal.

    Parameters
    ----------
    start : Start
        A first guess, placed by the image alone, so that it can be rearranged.
    measure : callable
        ``measure(gaussians)`` returns figures in decibels, by name.
    figure : str
        The one that counts.
    goal : float
        What it has to reach.
    most : int
        Splats, at most.
    schedule : Schedule
    iterations : int, optional
        Steps that a fit of a known number would take; the search takes up to about twice as many.
    cutoff : float, optional
        See `eigengs_dr.render`.
    progress : callable, optional
        ``progress(iteration, iterations, row)`` every 10 steps, with the last row of the trace.
    interrupted : callable, optional
        Asked before every step whether to stop with what there is.

    Returns
    -------
    Refined
        The smallest set that meets the goal, or else the best one. The trace has a row for every
        set that was judged, with iteration, gaussians and the figures; it stopped because the goal
        was "met", is "out of reach", or it was "interrupted".
    """
    run = _Run(start, measure, figure, goal, schedule, cutoff, progress, interrupted)
    tries, fit, settle = (max(1, round(share * iterations)) for share in (TRY, FIT, SETTLE))
    run.planned = TRIES * tries + fit + SETTLING * settle
    try:
        placed = _estimate(run, most, tries)
        if run.best.missing > 0 or len(run.best.gaussians) > 1:
            trial = _fit_estimate(run, placed, most, fit)
            # Of few iterations the tries have taken all.
            most_steps = max(LENGTH * iterations, run.step + SETTLING * settle)
            _settle(run, trial, most, settle, most_steps)
        pressed = interrupted()
    except KeyboardInterrupt:
        pressed = True
    met = "met" if run.best.missing <= 0 else "out of reach"
    return Refinement(run.best.gaussians, run.trace, run.step, "interrupted" if pressed else met)


class _Trial(NamedTuple):
    """What a descent led to, and how many decibels are missing there."""

    gaussians: Gaussians
    missing: float


@dataclass
class _Run:
    """What all descents of one search share, and what came of them."""

    start: FitProblem
    measure: Callable[[Gaussians], Row]
    figure: str
    goal: float
    schedule: Schedule
    cutoff: float
    progress: FitProgress | None
    interrupted: Callable[[], bool]
    planned: int = 0
    step: int = 0
    db_per_doubling: float = OCTAVE
    trace: list[Row] = field(default_factory=list)
    best: _Trial = field(init=False)

    def __post_init__(self) -> None:
        self.best = self.score(self.start.gaussians)

    def descend(self, gaussians: Gaussians, steps: int, share: float = 1.0) -> _Trial:
        """Take some steps at a share of the rates, unless interrupted, and judge the set."""
        rates = {name: share * rate for name, rate in self.schedule.rates.items()}
        schedule = replace(self.schedule, rates=rates)
        self.planned = max(self.planned, self.step + steps)
        sets = descend(
            gaussians, self.start.target, schedule, steps, self.cutoff, self.start.weight
        )
        current = next(sets)
        while not self.interrupted():
            following = next(sets, None)
            if following is None:
                break
            current = following
            self.step += 1
            if self.progress and self.step % 10 == 0:
                dr.sync_thread()  # steps run asynchronously; the bar tells what is done
                self.progress(self.step, self.planned, self.trace[-1])
        return self.score(dr.detach(current))

    def score(self, gaussians: Gaussians) -> _Trial:
        figures = self.measure(gaussians)
        row = {"iteration": self.step, "gaussians": len(gaussians), **figures}
        self.trace.append(row)
        trial = _Trial(gaussians, self.goal - figures[self.figure])
        if len(self.trace) == 1 or _better(trial, self.best):
            self.best = trial
        return trial


def _better(a: _Trial, b: _Trial) -> bool:
    """Whether a meets the goal with fewer splats than b; or comes nearer, where b does not."""
    if a.missing <= 0 and b.missing <= 0:
        return len(a.gaussians) < len(b.gaussians)
    return a.missing < b.missing


def _estimate(run: _Run, most: int, steps: int) -> Gaussians:
    """Place about as many splats as the goal takes, where some steps told that they belong."""
    assert run.start.redistribute is not None
    placed, before, last = run.start.gaussians, run.best, None
    for _ in range(TRIES):
        trial = run.descend(placed, steps)
        run.db_per_doubling = _db_per_doubling(last, trial, run.db_per_doubling)
        gain = TO_COME * max(0.0, before.missing - trial.missing)
        count = min(
            most, round(AIM * _count_for_gain(run, len(placed), trial.missing - gain, most))
        )
        # The first try stands where the image bends, not yet where error was left.
        close = last is not None and abs(count - len(placed)) <= CLOSE * len(placed)
        placed = run.start.redistribute(trial.gaussians, count)
        last, before = trial, run.score(placed)
        if close or run.interrupted():
            break
    return placed


def _fit_estimate(run: _Run, placed: Gaussians, most: int, steps: int) -> _Trial:
    """Fit, and once more where the estimate was far off: to place is better than to mend."""
    trial = run.descend(placed, steps)
    count = _count_for_gain(run, len(placed), trial.missing, most)
    if run.interrupted() or abs(count - len(placed)) <= FAR * len(placed):
        return trial
    assert run.start.redistribute is not None
    return run.descend(run.start.redistribute(trial.gaussians, count), steps)


def _db_per_doubling(last: _Trial | None, trial: _Trial, octave: float) -> float:
    """Decibels of twice as many splats, by two tries; as known where they are close."""
    if last is None:
        return octave
    apart = math.log2(len(trial.gaussians) / len(last.gaussians))
    if abs(apart) < APART:
        return octave
    return min(max((last.missing - trial.missing) / apart, SLOPES[0]), SLOPES[1])


def _count_for_gain(run: _Run, count: int, missing: float, most: int) -> int:
    """Splats that would gain so many decibels more."""
    octaves = min(max(missing / run.db_per_doubling, -math.log2(LEAP)), math.log2(LEAP))
    return min(most, max(1, round(count * 2**octaves)))


def _settle(run: _Run, trial: _Trial, most: int, steps: int, most_steps: int) -> None:
    """Drop splats while the goal is met, add some while it is not; `run` keeps the best set.

    Where few splats find a place, there would be no end: the steps of the search are limited.
    """
    target, weight = run.start.target, run.start.weight
    least_growth, rounds, gain = 1.02, 0, GAIN
    while run.step + steps <= most_steps and not run.interrupted():
        count, found = len(trial.gaussians), run.best
        if found.missing <= 0 and rounds >= SETTLING:
            return
        missing = trial.missing - gain
        if trial.missing <= 0:
            wanted = max(
                _count_for_gain(run, count, missing, count), math.floor((1 - DROP) * count)
            )
            if wanted == count or -missing < SURPLUS:
                return
            changed = prune(trial.gaussians, target, wanted, weight, run.cutoff)
        elif found.missing <= 0:
            # Between what failed and what was found lies the answer; steps alone may lead there.
            wanted = max(
                count, _count_for_gain(run, count, missing, (count + len(found.gaussians)) // 2)
            )
            changed = densify(trial.gaussians, target, wanted, weight, run.cutoff)
        else:
            wanted = max(
                _count_for_gain(run, count, missing, most), math.ceil(least_growth * count)
            )
            changed = densify(trial.gaussians, target, min(wanted, most), weight, run.cutoff)
            if len(changed) == count:  # no more are allowed, or no place takes from the error
                return
            least_growth = 2 * least_growth - 1
        rounds += 1
        expected = trial.missing + run.db_per_doubling * math.log2(count / len(changed))
        trial = run.descend(changed, steps, GENTLE)
        gain = AGAIN * max(0.0, expected - trial.missing)

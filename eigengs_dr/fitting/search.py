"""The search for the smallest number of Gaussians that reaches a PSNR.

The search has three stages. *Estimate*: short descents with few Gaussians ("tries") estimate the
number. Two tries measure the gain per doubling; each try shows where to place the Gaussians of the
next one (`eigengs_dr.fitting.place`). *Fit*: a longer descent with the estimate.
*Polish*: Gaussians are dropped (`eigengs_dr.fitting.exchange.prune`) while the set meets the goal,
and added while it does not; each change ends with a short descent.
"""

from __future__ import annotations

import math
from contextlib import closing, suppress
from dataclasses import dataclass, field
from typing import NamedTuple

import drjit as dr

from ..gaussian.gaussians import Gaussians
from .channels import Row
from .exchange import densify, prune
from .loop import Descent, Refinement, descend
from .objective import Pixels
from .redistribution import redistribute
from .state import State, begin

# The constants of a search, chosen on training photos of ImageNet classes. With a surplus in the
# fit, a fit of 1.0 and a margin of 1.1 take 4.6 and 1.6 % fewer Gaussians for 32 and 36 dB on 9
# training photos, and 2.7 % fewer for 40 dB on 4 of them, than a fit of 0.7 with a margin of 1.35
# and no surplus. With a margin of 1.05, one of the 9 photos takes twice as many for 32 dB, because
# no set in between meets the goal.

TRY_SHARE, FIT_SHARE, POLISH_SHARE = 0.1, 1.0, 0.15
"""Steps of a try, of the fit and of a polish, as fractions of the iterations."""

MAX_LENGTH = 2
"""Largest number of steps of the search, as a multiple of the iterations, if these exceed about
ten and one fit suffices; otherwise up to a quarter more."""

MAX_TRIES = 4
"""Largest number of tries. One alone takes 2 % more Gaussians with 1,000 iterations and 5 %
fewer with 300, in the same time (9 training photos, 32 to 40 dB); but two tries measure the
slope, without which a search does not converge where Gaussians gain much more than usual."""

MAX_POLISHES = 7
"""Number of polishes after which a search ends if a set meets the goal."""

SURE_POLISHES, SURE_DROPS = 3, 5
"""Number of polishes that a search may take regardless of its steps so far; and the number if the
fit met the goal, so that they drop Gaussians."""

DB_PER_DOUBLING = 4.0
"""Gain of twice as many Gaussians, in dB, until two tries of the image measure it; see
`eigengs_dr.fitting.redistribution.ERROR_EXPONENT`."""

DOUBLING_RANGE = (2.0, 12.0)
"""Allowed range of the measured gain, in dB; training images gained 1.6 to 8."""

MIN_OCTAVES = 0.25
"""Smallest distance of two tries that measures the gain, in doublings."""

LATE_SHARE = 0.37
"""Gain of a fit after the steps of a try, as a fraction of the gain in these steps; measured 0.3
to 0.5 with 80 to 4,000 Gaussians."""

MARGIN = 1.1
"""Gaussians of the fit over the estimated number; dropping some works better than adding some."""

MAX_OCTAVES = 4.0
"""Largest distance of two consecutive tries, in doublings."""

TRY_TOLERANCE, FIT_TOLERANCE = 0.1, 0.6
"""Largest relative difference from the estimated number for the last try, and largest relative
lack of Gaussians for the fit; the polishes handle a surplus."""

MAX_DROP, DROP_PER_DB, LARGEST_DROP = 0.15, 0.1, 0.3
"""Largest fraction of the Gaussians that one polish drops: near the goal, for each decibel above
it, and overall. A short search overshoots by decibels: 200 steps of a material fitted 11,122
Gaussians with 35.6 dB for 32 dB; a second fit of fewer, in the steps that were left, missed the
goal."""

POLISH_RATE = 0.5
"""Learning rates of a polish, as a fraction of those of the schedule."""

POLISH_GAIN, GAIN_DECAY = 0.1, 0.5
"""Expected gain of the first polish, in dB, and of the next polish, as a fraction of the gain of
the last; training images gained 0.2 dB."""

FAR = 1.5
"""Ratio of the Gaussians of the best set to those of a polish that misses the goal, above which
the polish ignores that set: a try may meet the goal with twice the number."""

ENOUGH = 0.02
"""Decibels above the goal that do not justify another polish."""


def search_count(
    descent: Descent, start: Gaussians, max_count: int, iterations: int = 1000
) -> Refinement:
    """Find the smallest number of Gaussians that meets a goal.

    Parameters
    ----------
    descent : Descent
        Its score says by how much a set is above the goal.
    start : Gaussians
        A first guess by the placement `Adaptive`, which can be redistributed.
    max_count : int
        Largest number of Gaussians.
    iterations : int, optional
        Steps of a fit with a known number; the search takes up to about twice as many, and a
        quarter more where the first fit is far off.

    Returns
    -------
    Refinement
        The smallest set that meets the goal, or else the best set. The trace has a row for every
        measured set, with iteration, gaussians and the values of `score`. `stopped` is "met",
        "out of reach" or "interrupted".
    """
    shares = (TRY_SHARE, FIT_SHARE, POLISH_SHARE)
    tries, fit, polish = (max(1, round(share * iterations)) for share in shares)
    planned = MAX_TRIES * tries + fit + MAX_POLISHES * polish
    run = _Run(descent, start, planned)
    try:
        run.score(start)
        estimate = _estimate(run, max_count, tries)
        if not run.ended() and (run.best.shortfall_db > 0 or len(run.best.gaussians) > 1):
            longest = round(MAX_LENGTH * iterations)
            trial = _fit_estimate(run, *estimate, max_count, fit, longest)
            # If the iterations are few, or two fits have used them up, polish all the same.
            sure = SURE_DROPS if trial.shortfall_db <= 0 else SURE_POLISHES
            max_steps = max(longest, run.step + sure * polish)
            _polish(run, trial, max_count, polish, max_steps)
    except KeyboardInterrupt:  # of a loss or a judge
        run.stopped = True
    if run.ended():
        with suppress(KeyboardInterrupt):
            _trim(run)
    met = "met" if run.best.shortfall_db <= 0 else "out of reach"
    stopped = "interrupted" if run.ended() else met
    return Refinement(run.best.gaussians, run.trace, run.step, stopped, run.best.row)


class _Trial(NamedTuple):
    """A set, by how many decibels it misses the goal, and its row of the trace."""

    gaussians: Gaussians
    shortfall_db: float
    row: Row


@dataclass
class _Run:
    """The state of one search."""

    descent: Descent
    start: Gaussians
    planned: int
    stopped: bool = False
    step: int = 0
    db_per_doubling: float = DB_PER_DOUBLING
    trace: list[Row] = field(default_factory=list)
    best: _Trial = field(init=False)

    def __post_init__(self) -> None:
        self.best = _Trial(self.start, math.inf, {})

    def descend(self, current: State, steps: int, share: float = 1.0) -> _Trial:
        """Take some steps at a fraction of the learning rates, and score the pruned set."""
        descent = self.descent
        method = descent.method.at_rates(share).without("densify", "redistribute")
        if share < 1:  # a polish moves Gaussians by itself
            method = method.without("relocate", "perturb")
        self.planned, before = max(self.planned, self.step + steps), self.step
        states = descend(descent.objective, method, current, steps, descent.key + before)
        try:
            with closing(states):
                for step, current in enumerate(states, 1):  # noqa: B007
                    self.step = before + step
                    if descent.progress and self.step % 10 == 0:
                        dr.sync_thread()  # steps run asynchronously; the bar shows finished steps
                        self.show(self.trace[-1])
                    if self.ended():
                        break
        except KeyboardInterrupt:  # of a loss; its set may be better than those measured
            self.stopped = True
        fitted = dr.detach(current.gaussians)
        # An interrupt may come before the last relocation.
        return self.score(prune(fitted, self.near(fitted), current.count))

    def redistribute(self, gaussians: Gaussians, count: int) -> Gaussians:
        """Place `count` Gaussians anew, denser where a set leaves more error."""
        steps, key = self.descent.method.solve_steps, self.descent.key
        return redistribute(gaussians, self.near(gaussians), count, steps, key)

    def near(self, gaussians: Gaussians) -> Pixels:
        """Return the squared error that stands for the objective near a set."""
        return self.descent.objective.near(gaussians)

    def score(self, gaussians: Gaussians) -> _Trial:
        [measured] = self.descent.score(gaussians)
        row = {"iteration": self.step, "gaussians": len(gaussians), **measured.row}
        self.trace.append(row)
        trial = _Trial(gaussians, -measured.margin, row)
        if len(self.trace) == 1 or _better(trial, self.best):
            self.best = trial
        self.show(row)
        return trial

    def show(self, row: Row) -> None:
        """Call `progress`, which may end the search by a `KeyboardInterrupt`."""
        if self.descent.progress and not self.stopped:
            try:
                self.descent.progress(self.step, self.planned, row)
            except KeyboardInterrupt:
                self.stopped = True

    def ended(self) -> bool:
        """Return whether the search was ended from outside."""
        return self.stopped or self.descent.interrupted()


def _better(a: _Trial, b: _Trial) -> bool:
    """Return whether a meets the goal with fewer Gaussians than b, or comes closer to it.

    Of two sets of one size that meet it, the one with the higher PSNR is better.
    """
    if a.shortfall_db <= 0 and b.shortfall_db <= 0:
        return (len(a.gaussians), a.shortfall_db) < (len(b.gaussians), b.shortfall_db)
    return a.shortfall_db < b.shortfall_db


def _estimate(run: _Run, max_count: int, steps: int) -> tuple[Gaussians, Gaussians]:
    """Estimate the number of Gaussians by tries, each placed where the one before left error.

    Return the set of the last try, and the estimated number placed where it left error.
    """
    placed, before, last = run.start, run.best, None
    for _ in range(MAX_TRIES):
        trial = run.descend(begin(placed), steps)
        # Few steps at full rates may lose more than they gain.
        trial = min(trial, before, key=lambda one: one.shortfall_db)
        _update_slope(run, last, trial)
        gain = LATE_SHARE * max(0.0, before.shortfall_db - trial.shortfall_db)
        count = min(
            max_count,
            round(MARGIN * _count_for_gain(run, len(placed), trial.shortfall_db - gain, max_count)),
        )
        # The first try was placed by the image, without errors: it does not count as close.
        close = last is not None and abs(count - len(placed)) <= TRY_TOLERANCE * len(placed)
        placed = run.redistribute(trial.gaussians, count)
        last, before = trial, run.score(placed)
        if close or run.ended():
            break
    return trial.gaussians, placed


def _fit_estimate(
    run: _Run, tried: Gaussians, placed: Gaussians, max_count: int, steps: int, max_steps: int
) -> _Trial:
    """Fit the estimated number; if it was far off, fit once more, in the steps that are left."""
    trial, number = _fit(run, tried, placed, steps), len(placed)
    count = _count_for_gain(run, number, trial.shortfall_db, max_count)
    if run.ended() or count - number <= FIT_TOLERANCE * number:
        return trial
    again = run.redistribute(trial.gaussians, count)
    return _fit(run, trial.gaussians, again, max(1, min(steps, max_steps - run.step)))


def _fit(run: _Run, tried: Gaussians, placed: Gaussians, steps: int) -> _Trial:
    """Fit the estimated number, with a surplus that is placed as well and leaves."""
    state = begin(placed)
    for control in run.descent.method.in_phase("densify"):
        state = control(state, run.descent.objective.image, 0, steps, 0)
    if state.surplus:
        state = state.replaced(run.redistribute(tried, state.most))
    return run.descend(state, steps)


def _update_slope(run: _Run, last: _Trial | None, trial: _Trial) -> None:
    """Measure the gain of twice as many Gaussians by two tries that are far enough apart."""
    if last is None:
        return
    octaves = math.log2(len(trial.gaussians) / len(last.gaussians))
    if abs(octaves) >= MIN_OCTAVES:
        low, high = DOUBLING_RANGE
        gain = last.shortfall_db - trial.shortfall_db
        run.db_per_doubling = min(max(gain / octaves, low), high)


def _count_for_gain(run: _Run, count: int, gain: float, max_count: int) -> int:
    """Return the number of Gaussians that would gain so many decibels more."""
    octaves = min(max(gain / run.db_per_doubling, -MAX_OCTAVES), MAX_OCTAVES)
    return min(max_count, max(1, round(count * 2**octaves)))


def _polish(run: _Run, trial: _Trial, max_count: int, steps: int, max_steps: int) -> None:
    """Drop Gaussians while the set meets the goal, else add some; `run` keeps the best set.

    `max_steps` limits the steps of the search: if `densify` finds few places, it would not end.
    """
    least_growth, rounds, gain = 1.02, 0, POLISH_GAIN
    while run.step + steps <= max_steps and not run.ended():
        count, best = len(trial.gaussians), run.best
        if best.shortfall_db <= 0 and rounds >= MAX_POLISHES:
            return
        shortfall = trial.shortfall_db - gain
        if trial.shortfall_db <= 0:
            drop = min(max(MAX_DROP, -DROP_PER_DB * trial.shortfall_db), LARGEST_DROP)
            new_count = max(
                _count_for_gain(run, count, shortfall, count),
                math.floor((1 - drop) * count),
            )
            if new_count == count or -shortfall < ENOUGH:
                return
            changed = prune(trial.gaussians, run.near(trial.gaussians), new_count)
        elif best.shortfall_db <= 0 and len(best.gaussians) <= FAR * count:
            # The best number lies between this one and that of the best set; or a polish suffices.
            new_count = max(
                count, _count_for_gain(run, count, shortfall, (count + len(best.gaussians)) // 2)
            )
            changed = densify(trial.gaussians, run.near(trial.gaussians), new_count)
        else:
            new_count = max(
                _count_for_gain(run, count, shortfall, max_count), math.ceil(least_growth * count)
            )
            changed = densify(trial.gaussians, run.near(trial.gaussians), min(new_count, max_count))
            if len(changed) == count:  # at `max_count`, or none would reduce the error
                return
            least_growth = 2 * least_growth - 1
        rounds += 1
        expected = trial.shortfall_db + run.db_per_doubling * math.log2(count / len(changed))
        trial = run.descend(begin(changed), steps, POLISH_RATE)
        gain = GAIN_DECAY * max(0.0, expected - trial.shortfall_db)


TRIMS = 5
"""Sets that an interrupted search tries without a step; each takes about as long as a step."""


def _trim(run: _Run) -> None:
    """Drop Gaussians of a set above the goal without a step, by bisection; `run` keeps the best."""
    above = run.best
    if above.shortfall_db > 0:
        return
    too_few = _count_for_gain(run, len(above.gaussians), above.shortfall_db, len(above.gaussians))
    for _ in range(TRIMS):
        new_count = (too_few + len(above.gaussians)) // 2
        if new_count in (too_few, len(above.gaussians)):
            return
        near = run.near(above.gaussians)
        trial = run.score(prune(above.gaussians, near, new_count))
        above, too_few = (trial, too_few) if trial.shortfall_db <= 0 else (above, new_count)

"""Rounding as coarse as a loss of PSNR allows: the search of the steps, and error feedback.

All steps follow from one, see `eigengs_dr.codec.quantization`. `round_within` searches the
largest one that the loss allows, first without error feedback, which is fast, then with it.

With error feedback, Gaussians that are not yet rounded compensate for those that are. The Gaussians
are divided into groups; neighbours along a Hilbert curve are in different groups. One group after
another is rounded with all its parameters. After each group, the others descend on the error that
is left. On training photos at equal error this saves 3 bits for each Gaussian, a tenth of the file.
A set in several sections gets no compensation, because a reader may stop after any section.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import types_of
from ..fitting.descent import begin
from ..fitting.loop import descend, last
from ..fitting.method import DEFAULT
from ..fitting.objective import Pixels
from ..fitting.solve import solve
from ..gaussian.gaussians import Gaussians, like
from ..raster.render import render
from .cells import hilbert_encode
from .egs import EgsContent
from .quantization import DEAD_ZONE, Steps, Symbols, dequantize, quantize

Array = NDArray[np.floating]

MIN_MSE = 1e-9
"""Smallest mean squared error that counts: 90 dB."""

FIRST_STEP = 0.06
"""Step of the colours at which the search starts."""

CELLS = 4
"""Cells for the mean distance of Gaussians: some lie in one cell, and few bits tell the rest."""

FEEDBACK = 0.6
"""Error that rounding adds with error feedback, relative to that without, on training photos."""

TOO_FINE = "pack: no rounding is fine enough for the budget; allow more dB"


class Comparison(NamedTuple):
    """What the loss of a set is measured by.

    Attributes
    ----------
    error : callable
        ``error(gaussians)`` returns the mean squared error of a set.
    target : ndarray, shape (H, W, C)
        What compensation for the rounding aims at, in the space of the set.
    unseen : float
        Mean squared error that `error` does not see, and that adds to it.
    """

    error: Callable[[Gaussians], float]
    target: Array
    unseen: float


def round_within(
    gaussians: Gaussians, compared: Comparison, max_psnr_drop: float, rows: list[slice]
) -> tuple[Attempt, float]:
    """Round a set as coarsely as a budget allows.

    Parameters
    ----------
    gaussians : Gaussians
        Set without gradients.
    compared : Comparison
    max_psnr_drop : float
        Allowed loss in dB of each prefix: of the Gaussians up to the end of each section.
    rows : list of slice
        The sections.

    Returns
    -------
    Attempt
        The best one.
    float
        The mean squared error before, with what is unseen.

    Raises
    ------
    ValueError
        If no rounding meets the budget.
    """
    unseen = compared.unseen

    def errors(found: Gaussians) -> list[float]:
        return [compared.error(part) for part in (*(found[: r.stop] for r in rows[:-1]), found)]

    before = [max(error + unseen, MIN_MSE) for error in errors(gaussians)]
    limits = [error * 10 ** (max_psnr_drop / 10) - unseen for error in before]
    if min(limits) <= 0:
        raise ValueError(TOO_FINE)

    def judge(packed: EgsContent) -> Attempt:
        after = errors(Gaussians.from_data(packed.set_data(), types_of(gaussians.mean).backend))
        shares = [
            (e + unseen - b) / (m + unseen - b)
            for e, m, b in zip(after, limits, before, strict=True)
        ]
        return Attempt(max(shares), packed, after[-1])  # the worst prefix counts

    def plain(octaves: float) -> Attempt:
        return judge(quantize_sections(gaussians, _steps(gaussians, octaves), rows))

    def compensated(octaves: float) -> Attempt:
        steps = _steps(gaussians, octaves)
        return judge(quantize_with_feedback(gaussians, compared.target, steps))

    found = largest_within(plain)
    if len(rows) == 1:  # compensation for the whole set would harm its prefixes
        least = MIN_OCTAVES if found is None else found[0]
        start = least if found is None else least - 0.5 * np.log2(FEEDBACK)
        found = largest_within(compensated, start, least) or found
    if found is None:
        raise ValueError(TOO_FINE)
    return found[1], before[-1]


def _steps(gaussians: Gaussians, octaves: float) -> Steps:
    """Return steps in single precision, as in the file."""
    cell = (gaussians.width * gaussians.height / len(gaussians)) ** 0.5 / CELLS
    values = np.array([FIRST_STEP * 2.0**octaves, cell], np.float32)
    return Steps(*values.tolist())


MIN_OCTAVES, MAX_OCTAVES = -14.0, 6.0
"""Range of the search around the first step, in octaves."""

MAX_MOVE = 2.0
"""Largest distance of two attempts, in octaves."""

ENOUGH, ATTEMPTS = 0.97, 4
"""Part of the budget that leaves no room worth another attempt, and number of attempts."""

FAIR, MAX_ATTEMPTS = 0.9, 10
"""Part of the budget that must be used after `ATTEMPTS`, and attempts after which it need not."""

MARGIN = 0.01
"""Octaves below the crossing at which the next attempt is."""


class Attempt(NamedTuple):
    """One step and what it gives.

    Attributes
    ----------
    excess : float
        Error that rounding adds, relative to the largest that the budget allows.
    packed : EgsContent
        The rounded set.
    error : float
        Its mean squared error.
    """

    excess: float
    packed: EgsContent
    error: float


def largest_within(
    attempt: Callable[[float], Attempt], start: float = 0.0, least: float = MIN_OCTAVES
) -> tuple[float, Attempt] | None:
    """Search the largest step whose error stays within a limit, by few attempts.

    The error is about ``e_0 + k step^2``: rounding adds error, and the compensation for it may
    improve the set. Every step rounds all numbers anew, so the error is random too: by 10 % of the
    budget for 100 Gaussians, and 1 % for 3,000. The last two attempts give e_0 and k, and with them
    the step at which the error should cross the limit. The next attempt is there, or a little below
    it.

    Parameters
    ----------
    attempt : callable
        ``attempt(octaves)`` rounds with ``2**octaves`` times some first step.
    start : float, optional
        Octaves of the first attempt.
    least : float, optional
        Octaves of the smallest step to try.

    Returns
    -------
    (float, Attempt) or None
        The octaves and the attempt; None if the smallest step exceeds the limit.
    """
    octaves = start
    tried: dict[float, float] = {}
    best: tuple[float, Attempt] | None = None
    while True:
        found = attempt(octaves)
        tried[octaves] = found.excess
        if found.excess <= 1 and (best is None or octaves > best[0]):
            best = octaves, found
        goal = _crossing(list(tried.items())) - MARGIN
        if best is None:
            if octaves <= least:
                return None
            octaves = max(min(goal, min(tried) - MARGIN * len(tried)), least)
            continue
        low, used = best[0] + MARGIN, best[1].excess
        high = min((place for place in tried if place > best[0]), default=MAX_OCTAVES + MARGIN)
        enough = used >= ENOUGH or (len(tried) >= ATTEMPTS and used >= FAIR)
        if low > high - MARGIN or enough or len(tried) >= MAX_ATTEMPTS:
            return best
        octaves = min(max(goal, low), high - MARGIN)


def _crossing(tried: list[tuple[float, float]]) -> float:
    """Return the octaves at which the error should cross the limit."""
    octaves, excess = tried[-1]
    offset, slope = 0.0, excess * 4.0**-octaves
    before, error = tried[max(len(tried) - 2, 0)]
    if before != octaves:
        slope = (excess - error) / (4.0**octaves - 4.0**before)
        offset = excess - slope * 4.0**octaves
    if slope <= 0 or offset >= 1:  # noise, or an improvement: go on by the larger steps
        return octaves + (MAX_MOVE if excess <= 0 else float(np.clip(1 - excess, -1, 1)))
    crossing = 0.5 * np.log2(max((1 - offset) / slope, 1e-30))
    return octaves + float(np.clip(crossing - octaves, -MAX_MOVE, MAX_MOVE))


GROUPS = 16
"""Groups of Gaussians, at most."""

STEPS = 12
"""Steps of descent after each group but the last one."""

RATE = 0.2
"""Learning rates of this descent, as a fraction of those of `fit`: the optimum is near."""


def quantize_with_feedback(gaussians: Gaussians, target: Array, steps: Steps) -> EgsContent:
    """Round a set; let the Gaussians not yet rounded compensate.

    Parameters
    ----------
    gaussians : Gaussians
        Set without gradients.
    target : ndarray, shape (H, W, C)
        Target of the rendering, in the space of the set.
    steps : Steps

    Returns
    -------
    EgsContent
        One section.

    Raises
    ------
    ValueError
        If a number would be too large to store.
    """
    count = len(gaussians)
    groups = min(GROUPS, count)
    group_of = np.argsort(_along_curve(gaussians)) % groups
    slow = replace(DEFAULT.at_rates(RATE), controls=())
    free, rest = np.arange(count), np.asarray(target, np.float32)
    done: list[Symbols] = []
    current, inside = gaussians, _all_inside(gaussians)
    for group in range(groups):
        arrays, now = current.to_arrays(), group_of[free] == group
        chosen = {name: arrays[name][now] for name in ("mean", "factor", "color")}
        done.append(quantize(chosen, steps, DEAD_ZONE))
        free = free[~now]
        if not len(free):
            break
        rest = rest - planes_of(like(gaussians, **dequantize(done[-1], steps)))
        objective = Pixels.plain(rest, current)
        current = solve(current[np.flatnonzero(~now)], objective, 2, warm_start=True)
        if inside:  # descent would move means outside the image into it
            current = last(descend(objective, slow, begin(current), STEPS), current)
    symbols = Symbols(*map(np.concatenate, zip(*done, strict=True)))
    return _content(gaussians, [symbols], steps, current.to_arrays()["background"])


def quantize_sections(gaussians: Gaussians, steps: Steps, rows: list[slice]) -> EgsContent:
    """Round a set without compensation, in sections of these ranges of Gaussians."""
    arrays = gaussians.to_arrays()
    symbols = quantize(arrays, steps, DEAD_ZONE)
    return _content(gaussians, [symbols.select(r) for r in rows], steps, arrays["background"])


def planes_of(gaussians: Gaussians) -> NDArray[np.float32]:
    """Render a set in its own space."""
    return np.asarray(render(replace(gaussians, space="data")).numpy(), np.float32)


def _content(
    gaussians: Gaussians, sections: list[Symbols], steps: Steps, background: NDArray[np.float32]
) -> EgsContent:
    """Return the content of a file for a set."""
    size = (gaussians.width, gaussians.height)
    return EgsContent(sections, steps, background, size, gaussians.space, gaussians.cutoff)


def _along_curve(gaussians: Gaussians) -> NDArray[np.intp]:
    """Return the order of the means along a Hilbert curve."""
    mean = gaussians.to_arrays()["mean"]
    low = mean.min(axis=0)
    unit = 1023 / max(float((mean - low).max()), 1e-6)
    return np.argsort(hilbert_encode(((mean - low) * unit).astype(np.int64), 10), kind="stable")


def _all_inside(gaussians: Gaussians) -> bool:
    """Return whether all means lie in the image, except for rounding."""
    mean, size = gaussians.to_arrays()["mean"], np.array([gaussians.width, gaussians.height])
    return bool((np.abs(mean - size / 2) <= size / 2 * (1 + 1e-4)).all())

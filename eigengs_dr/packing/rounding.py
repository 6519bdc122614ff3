"""Rounding as coarsely as a loss of PSNR allows: the search for the steps, and error feedback.

All steps follow from one, see `eigengs_dr.codec.quantization`. `round_within` searches for the
largest one that the loss allows, first without error feedback, which is fast, then with it.

With error feedback, Gaussians that are not yet rounded compensate for those that are. The Gaussians
are divided into groups; neighbours along a Hilbert curve are in different groups. The groups are
rounded one after another, with all their parameters. After each group, the remaining Gaussians
descend on the remaining error. On training photos at equal error this saves 3 bits per Gaussian, a
tenth of the file. A set in several sections gets no compensation, because a reader may stop after
any section.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import types_of
from ..codec.egs import EgsContent
from ..codec.quantization import DEAD_ZONE, Steps, Symbols, dequantize, quantize
from ..codec.range_coder import hilbert_encode
from ..fitting.loop import descend, last
from ..fitting.method import DEFAULT
from ..fitting.objective import Objective, Pixels
from ..fitting.solve import solve
from ..fitting.state import begin
from ..gaussian.file import packed_data
from ..gaussian.gaussians import Gaussians, like
from ..image.space import DATA
from ..raster.render import render

Array = NDArray[np.floating]

MIN_MSE = 1e-9
"""Lower bound of mean squared errors: 90 dB."""

FIRST_STEP = 0.06
"""Step of the colours at which the search starts, with 1 as white, times pixels."""

CELLS_PER_SPACING = 4
"""Number of cells per mean distance of Gaussians. Few Gaussians share a cell, and few bits give the
position inside the cell."""

FEEDBACK_ERROR_RATIO = 0.6
"""Ratio of the errors that rounding adds with and without error feedback, on training photos."""

TOO_FINE = "pack: no rounding is fine enough for the budget; allow more dB"


class Comparison(NamedTuple):
    """The measure of the loss of a set.

    Attributes
    ----------
    error : callable
        ``error(gaussians)`` returns the mean squared error of a set.
    target : ndarray, shape (H, W, C)
        Target of the compensation for the rounding, in the space of the set.
    extra_error : float
        Mean squared error that is not included in `error`, and is added to it.
    dead_zone : float
        Fraction of a step by which colours are rounded towards 0.
    """

    error: Callable[[Gaussians], float]
    target: Array
    extra_error: float
    dead_zone: float = DEAD_ZONE


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
        Allowed loss in dB of each prefix: the Gaussians up to the end of each section.
    rows : list of slice
        The sections.

    Returns
    -------
    Attempt
        The best attempt.
    float
        The mean squared error before rounding, including `Comparison.extra_error`.

    Raises
    ------
    ValueError
        If no rounding meets the budget.
    """
    extra = compared.extra_error

    def errors(candidate: Gaussians) -> list[float]:
        prefixes = (*(candidate[: r.stop] for r in rows[:-1]), candidate)
        return [compared.error(prefix) for prefix in prefixes]

    before = [max(error + extra, MIN_MSE) for error in errors(gaussians)]
    limits = [error * 10 ** (max_psnr_drop / 10) - extra for error in before]
    if min(limits) <= 0:
        raise ValueError(TOO_FINE)

    def evaluate(packed: EgsContent) -> Attempt:
        after = errors(Gaussians.from_data(packed_data(packed), types_of(gaussians.mean).backend))
        shares = [
            (e + extra - b) / (m + extra - b) for e, m, b in zip(after, limits, before, strict=True)
        ]
        return Attempt(max(shares), packed, after[-1])  # the worst prefix counts

    def plain(octaves: float) -> Attempt:
        steps = _steps(gaussians, octaves)
        return evaluate(quantize_sections(gaussians, steps, rows, compared.dead_zone))

    def compensated(octaves: float) -> Attempt:
        steps = _steps(gaussians, octaves)
        return evaluate(
            quantize_with_feedback(gaussians, compared.target, steps, compared.dead_zone)
        )

    best = largest_within(plain)
    if len(rows) == 1:  # compensation for the full set would harm its prefixes
        least = MIN_OCTAVES if best is None else best[0]
        start = least if best is None else least - 0.5 * np.log2(FEEDBACK_ERROR_RATIO)
        best = largest_within(compensated, start, least) or best
    if best is None:
        raise ValueError(TOO_FINE)
    return best[1], before[-1]


def _steps(gaussians: Gaussians, octaves: float) -> Steps:
    """Return the steps in single precision, as in the file."""
    cell = (gaussians.width * gaussians.height / len(gaussians)) ** 0.5 / CELLS_PER_SPACING
    values = np.array([FIRST_STEP * 2.0**octaves, cell], np.float32)
    return Steps(*values.tolist())


MIN_OCTAVES, MAX_OCTAVES = -14.0, 6.0
"""Range of the search around the first step, in octaves."""

MAX_CHANGE = 2.0
"""Largest change between two attempts, in octaves."""

SUFFICIENT_SHARE, MIN_ATTEMPTS = 0.97, 4
"""Share of the budget at which the search stops at once, and number of attempts after which
`ACCEPTED_SHARE` suffices."""

ACCEPTED_SHARE, MAX_ATTEMPTS = 0.9, 10
"""Share of the budget that suffices after `MIN_ATTEMPTS`, and largest number of attempts."""

MARGIN = 0.01
"""Distance of the next attempt below the predicted crossing, in octaves."""


class Attempt(NamedTuple):
    """The result of one step size.

    Attributes
    ----------
    excess : float
        Error that rounding adds, relative to the largest error that the budget allows.
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
    """Search for the largest step whose error stays within a limit, in few attempts.

    The error is about ``e_0 + k step^2``: rounding adds error, and the compensation for it may
    improve the set. Every step rounds all numbers anew, so the error has a random part too: 10 % of
    the budget for 100 Gaussians, and 1 % for 3,000. The last two attempts determine e_0 and k, and
    so the step at which the error should cross the limit. The next attempt is there or slightly
    below.

    Parameters
    ----------
    attempt : callable
        ``attempt(octaves)`` rounds with ``2**octaves`` times the first step.
    start : float, optional
        Octaves of the first attempt.
    least : float, optional
        Octaves of the smallest step that is tried.

    Returns
    -------
    (float, Attempt) or None
        The octaves and the attempt; None if the smallest step exceeds the limit.
    """
    octaves = start
    tried: dict[float, float] = {}
    best: tuple[float, Attempt] | None = None
    while True:
        result = attempt(octaves)
        tried[octaves] = result.excess
        if result.excess <= 1 and (best is None or octaves > best[0]):
            best = octaves, result
        goal = _crossing(list(tried.items())) - MARGIN
        if best is None:
            if octaves <= least:
                return None
            octaves = max(min(goal, min(tried) - MARGIN * len(tried)), least)
            continue
        low, used = best[0] + MARGIN, best[1].excess
        high = min((place for place in tried if place > best[0]), default=MAX_OCTAVES + MARGIN)
        needed = ACCEPTED_SHARE if len(tried) >= MIN_ATTEMPTS else SUFFICIENT_SHARE
        if low > high - MARGIN or used >= needed or len(tried) >= MAX_ATTEMPTS:
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
    if slope <= 0 or offset >= 1:  # noise or an improvement: continue with a fixed change
        return octaves + (MAX_CHANGE if excess <= 0 else float(np.clip(1 - excess, -1, 1)))
    crossing = 0.5 * np.log2(max((1 - offset) / slope, 1e-30))
    return octaves + float(np.clip(crossing - octaves, -MAX_CHANGE, MAX_CHANGE))


MAX_GROUPS = 16
"""Largest number of groups of Gaussians."""

FEEDBACK_STEPS = 12
"""Number of descent steps after each group except the last one."""

FEEDBACK_RATE = 0.2
"""Learning rates of this descent, relative to those of `fit`, because the optimum is near."""


def quantize_with_feedback(
    gaussians: Gaussians, target: Array, steps: Steps, dead_zone: float
) -> EgsContent:
    """Round a set, while the Gaussians that are not yet rounded compensate.

    Parameters
    ----------
    gaussians : Gaussians
        Set without gradients.
    target : ndarray, shape (H, W, C)
        Target of the rendering, in the space of the set.
    steps : Steps
    dead_zone : float
        See `Comparison`.

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
    groups = min(MAX_GROUPS, count)
    group_of = np.argsort(_along_curve(gaussians)) % groups
    method = replace(DEFAULT.at_rates(FEEDBACK_RATE), controls=())
    free, rest = np.arange(count), np.asarray(target, np.float32)
    done: list[Symbols] = []
    current, inside = gaussians, _all_inside(gaussians)
    for group in range(groups):
        arrays, in_group = current.to_arrays(), group_of[free] == group
        selected = {name: arrays[name][in_group] for name in ("mean", "factor", "color")}
        done.append(quantize(selected, steps, dead_zone))
        free = free[~in_group]
        if not len(free):
            break
        rest = rest - planes_of(like(gaussians, **dequantize(done[-1], steps)))
        objective = Pixels.plain(rest, current)
        current = solve(current[np.flatnonzero(~in_group)], objective, 2, warm_start=True)
        if inside:  # the descent would clip means to the image
            states = descend(Objective(objective), method, begin(current), FEEDBACK_STEPS)
            current = last(states, current)
    symbols = Symbols(*map(np.concatenate, zip(*done, strict=True)))
    return _content(gaussians, [symbols], steps, current.to_arrays()["background"])


def quantize_sections(
    gaussians: Gaussians, steps: Steps, rows: list[slice], dead_zone: float
) -> EgsContent:
    """Round a set without compensation, divided into sections by ranges of Gaussians."""
    arrays = gaussians.to_arrays()
    symbols = quantize(arrays, steps, dead_zone)
    return _content(gaussians, [symbols.select(r) for r in rows], steps, arrays["background"])


def planes_of(gaussians: Gaussians) -> NDArray[np.float32]:
    """Render a set in its own space, without decoding."""
    return np.asarray(render(replace(gaussians, space=DATA)).numpy(), np.float32)


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

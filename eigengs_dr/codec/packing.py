"""The function `pack`, which writes a set to the smallest file within a given loss of PSNR.

All steps follow from one, see `eigengs_dr.codec.quantization`. `pack` searches the largest one that
the loss allows, first without error feedback, which is fast, then with it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..backend.arrays import types_of
from ..backend.display import to_html
from ..backend.recording import exclusive
from ..fitting.fit import Fit
from ..gaussian.gaussians import Gaussians
from ..gaussian.like import set_of
from ..image.color import LIGHT, UNBOUNDED, rendered_as, rgb_to_ycbcr, to_coded, to_linear
from ..image.io import read_image
from ..image.metrics import MAX_PSNR, psnr_from_mse
from ..image.pixels import check_data, check_image
from ..image.radiance import to_log, to_pu21
from ..material.maps import TextureMap
from ..raster.render import render
from .egs import MAX_SECTIONS, SUFFIX, EgsContent, write
from .error_feedback import quantize_sections, quantize_with_feedback, to_gaussians
from .quantization import Steps

Array = NDArray[np.floating]

BUDGET = 0.5
"""Loss of PSNR by default, in dB. For a larger loss, fewer Gaussians save more bits."""

MSE_WITHOUT_IMAGE = 1e-4
"""Mean squared error that `pack` assumes for a set if it has no image: 40 dB."""

MIN_MSE = 1e-9
"""Smallest mean squared error that counts: 90 dB."""

FIRST_STEP = 0.06
"""Step of the colours at which the search starts."""

CELLS = 4
"""Cells for the mean distance of Gaussians: some lie in one cell, and few bits tell the rest."""

FEEDBACK = 0.6
"""Error that rounding adds with error feedback, relative to that without, on training photos."""

TOO_FINE = "pack: no rounding is fine enough for the budget; allow more dB"


class PackResult(NamedTuple):
    """Result of `pack`.

    Attributes
    ----------
    gaussians : Gaussians
        The rounded set in the order of the file.
    bytes : int
        Size of the file.
    bits_per_pixel : float
        Bits of the file per pixel of the native size.
    psnr : float
        PSNR of the rendering of the rounded set in dB, in the space of the budget, against the
        image; without an image, against the rendering of the set before rounding.
    psnr_drop : float
        Loss of PSNR in dB; without an image, from 40 dB.
    steps : Steps
        Steps of the rounding.
    """

    gaussians: Gaussians
    bytes: int
    bits_per_pixel: float
    psnr: float
    psnr_drop: float
    steps: Steps

    def _repr_html_(self) -> str:
        """Return what a notebook shows."""
        return to_html(self)


@exclusive()
def pack(
    gaussians: Gaussians | Fit,
    output: str | os.PathLike[str],
    image: ArrayLike | None = None,
    max_psnr_drop: float = BUDGET,
    sections: Sequence[int] | None = None,
    cutoff: float | None = None,
    encoding: str | None = None,
) -> PackResult:
    """Write a set to the smallest ``.egs`` file whose loss of PSNR stays within a budget.

    Parameters
    ----------
    gaussians : Gaussians or Fit
    output : path-like
        File to write; `pack` replaces an existing file atomically. `Gaussians.load` reads it.
    image : array_like, shape (H, W, 3), (H, W, 1) or (H, W), optional
        The image of the fit, as `fit` takes it. By default the rendering of the set.
    max_psnr_drop : float, optional
        Largest loss of PSNR in dB, above 0 and at most 100: against the image, at the native size
        and in the space of the set (psnr_ycbcr for YCbCr; `pack` compares linear light as sRGB, and
        radiance in PU21).
        Without an image, the loss of a set of 40 dB if the errors add.
    sections : sequence of int, optional
        Number of Gaussians in each section of the file, in the order of the set. A reader may stop
        after any section; the budget holds for each of these prefixes. By default one section.
        Inside a section, Gaussians are stored in Hilbert-curve order.
    cutoff : float, optional
        Radius of a Gaussian in standard deviations; by default the cutoff of the set.
    encoding : {"srgb", "linear"}, optional
        What the pixels of the image are, see `eigengs_dr.fit`.

    Returns
    -------
    PackResult

    Raises
    ------
    ValueError
        If the image or an argument does not fit the set, the suffix is not ``.egs``, or no file
        meets the budget.
    OSError
        If the file cannot be written; an existing file then stays unchanged.

    Notes
    -----
    On one machine and backend, the same arguments give the same file bit for bit.
    """
    check_request(output, max_psnr_drop)
    whole: Gaussians = dr.detach(set_of(gaussians))
    rows = section_rows(len(whole), sections)
    if cutoff is not None:
        whole = replace(whole, cutoff=float(cutoff))
    shown = _shown(whole) if image is None else _compared(whole, image, encoding)
    # The best linear light is not the best sRGB picture. So compensation keeps a set in linear
    # light near its own rendering, not near the image.
    keeps = image is None or whole.space in LIGHT
    target = _planes_of(whole) if keeps else shown
    unseen = MSE_WITHOUT_IMAGE if image is None else 0

    def errors(found: Gaussians) -> list[float]:
        parts = [*(found[: r.stop] for r in rows[:-1]), found]
        return [_error(part, shown) for part in parts]

    figures = write_smallest(output, whole, target, errors, max_psnr_drop, rows, unseen)
    found = Gaussians.load(output, types_of(whole.mean).backend)
    return PackResult(gaussians=found, **figures)


def write_smallest(
    output: str | os.PathLike[str],
    gaussians: Gaussians,
    target: Array,
    errors: Callable[[Gaussians], list[float]],
    max_psnr_drop: float,
    rows: list[slice],
    unseen: float = 0.0,
    maps: tuple[TextureMap, ...] = (),
) -> dict[str, Any]:
    """Round a set as coarsely as a budget allows, and write the file.

    Parameters
    ----------
    output : path-like
    gaussians : Gaussians
        Set without gradients.
    target : ndarray, shape (H, W, C)
        What compensation for the rounding aims at, in the space of the set.
    errors : callable
        ``errors(gaussians)`` returns the mean squared error of each prefix that `rows` end at.
    max_psnr_drop : float
        Allowed loss of each prefix in dB.
    rows : list of slice
        The sections.
    unseen : float, optional
        Mean squared error that `errors` does not see, and that adds to it.
    maps : tuple of TextureMap, optional
        The maps of a material, by whose weights the colours are multiplied.

    Returns
    -------
    dict
        bytes, bits_per_pixel, psnr, psnr_drop and steps of the result, see `PackResult`.

    Raises
    ------
    ValueError
        If no rounding meets the budget.
    OSError
        If the file cannot be written; an existing file then stays unchanged.
    """
    before = [max(error + unseen, MIN_MSE) for error in errors(gaussians)]
    limits = [error * 10 ** (max_psnr_drop / 10) - unseen for error in before]
    if min(limits) <= 0:
        raise ValueError(TOO_FINE)

    def judge(packed: EgsContent) -> Attempt:
        after = zip(errors(to_gaussians(packed, gaussians)), limits, before, strict=True)
        # The worst prefix counts.
        return Attempt(max((e + unseen - b) / (m + unseen - b) for e, m, b in after), packed)

    def plain(octaves: float) -> Attempt:
        return judge(quantize_sections(gaussians, _steps(gaussians, octaves), rows))

    def compensated(octaves: float) -> Attempt:
        return judge(quantize_with_feedback(gaussians, target, _steps(gaussians, octaves)))

    found = largest_within(plain)
    if len(rows) == 1:  # compensation for the whole set would harm its prefixes
        least = MIN_OCTAVES if found is None else found[0]
        start = least if found is None else least - 0.5 * np.log2(FEEDBACK)
        found = largest_within(compensated, start, least) or found
    if found is None:
        raise ValueError(TOO_FINE)
    packed = found[1].packed
    after = errors(to_gaussians(packed, gaussians))[-1]
    size = write(output, packed._replace(maps=maps))
    return {
        "bytes": size,
        "bits_per_pixel": 8 * size / (gaussians.width * gaussians.height),
        "psnr": psnr_from_mse(after),
        "psnr_drop": psnr_from_mse(before[-1]) - psnr_from_mse(max(after + unseen, MIN_MSE)),
        "steps": packed.steps,
    }


def _steps(gaussians: Gaussians, octaves: float) -> Steps:
    """Return steps in single precision, as in the file."""
    cell = (gaussians.width * gaussians.height / len(gaussians)) ** 0.5 / CELLS
    values = np.array([FIRST_STEP * 2.0**octaves, cell], np.float32)
    return Steps(*values.tolist())


def check_request(output: str | os.PathLike[str], max_psnr_drop: float) -> None:
    """Raise ValueError for another suffix than ``.egs``, or a budget out of range."""
    if Path(output).suffix.lower() != SUFFIX:
        raise ValueError(f"{output}: pack writes {SUFFIX} files; use this suffix, or save()")
    if not 0 < max_psnr_drop <= MAX_PSNR:
        raise ValueError(
            f"pack: max_psnr_drop is {max_psnr_drop}; it must be above 0 and at most "
            f"{MAX_PSNR:g} dB, such as 0.5"
        )


def section_rows(count: int, sections: Sequence[int] | None) -> list[slice]:
    """Return the range of the Gaussians of each section."""
    counts = [count] if sections is None else [int(k) for k in sections]
    if not counts or min(counts) < 1 or sum(counts) != count or len(counts) > MAX_SECTIONS:
        raise ValueError(
            f"pack: sections are {counts[:8]}, expected 1 to {MAX_SECTIONS} numbers of Gaussians "
            f"above 0 whose sum is {count}"
        )
    ends = np.cumsum(counts).tolist()
    return [slice(end - k, end) for end, k in zip(ends, counts, strict=True)]


def _compared(gaussians: Gaussians, image: ArrayLike, encoding: str | None) -> Array:
    """Return the image in the space of the comparison.

    It is the set's space; for linear light, sRGB, and for light above 1, PU21, which has bounds.
    """
    grey = gaussians.channels == 1
    data = rendered_as(gaussians.space) is None
    image = read_image(image, data, None if data else encoding)
    pixels = check_data(image) if data else check_image(image, grey, encoding=encoding)
    expected = (gaussians.height, gaussians.width, gaussians.channels)
    if pixels.shape != expected:
        raise ValueError(f"pack: image has shape {pixels.shape}, the set needs {expected}")
    if gaussians.space == "ycbcr":
        return rgb_to_ycbcr(pixels)
    if gaussians.space in UNBOUNDED:
        light = to_linear(pixels)
        return to_log(light) if gaussians.space == "log" else to_pu21(light)
    return pixels


def _shown(gaussians: Gaussians) -> Array:
    """Render a set in the space of the comparison, see `_compared`."""
    planes = _planes_of(gaussians)
    if gaussians.space == "radiance":
        return to_pu21(planes)
    return to_coded(np.maximum(planes, 0)) if gaussians.space == "linear" else planes


def _planes_of(gaussians: Gaussians) -> Array:
    """Render a set in its own space."""
    return render(replace(gaussians, space="data")).numpy()


def _error(gaussians: Gaussians, shown: Array) -> float:
    return float(np.mean(np.square(_shown(gaussians) - shown, dtype=np.float64)))


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
    """

    excess: float
    packed: EgsContent


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
    octaves, tried = start, list[tuple[float, float]]()
    best: tuple[float, Attempt] | None = None
    while True:
        found = attempt(octaves)
        tried.append((octaves, found.excess))
        if found.excess <= 1 and (best is None or octaves > best[0]):
            best = octaves, found
        goal = _crossing(tried) - MARGIN
        if best is None:
            if octaves <= least:
                return None
            lowest = min(place for place, _ in tried)
            octaves = max(min(goal, lowest - MARGIN * len(tried)), least)
            continue
        low = best[0] + MARGIN
        high = min((place for place, _ in tried if place > best[0]), default=MAX_OCTAVES + MARGIN)
        if low > high - MARGIN or _is_enough(best, len(tried)):
            return best
        octaves = min(max(goal, low), high - MARGIN)


def _is_enough(best: tuple[float, Attempt], number: int) -> bool:
    """Return whether the best of a number of attempts is good enough."""
    used = best[1].excess
    if used >= ENOUGH or number >= MAX_ATTEMPTS:
        return True
    return number >= ATTEMPTS and used >= FAIR


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

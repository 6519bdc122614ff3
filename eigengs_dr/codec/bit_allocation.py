"""`pack`: the smallest file of a set of Gaussians that a stated loss of quality allows.

The error of rounding is ``D = sum_g k_g Delta_g^2`` with a step ``Delta_g`` for each kind of
parameter, and a bit less for each of its ``n_g`` numbers doubles the step. Where no bit can be
moved to another kind for less error, all ``k_g Delta_g^2 / n_g`` are equal (reverse
water-filling; Cover and Thomas, Elements of Information Theory, section 10.3.3). The ``k_g`` are
measured, and one common factor of the steps is then searched for.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..backend.arrays import types_of
from ..gaussian.covariance import log_shapes, sizes_from_log_shapes
from ..gaussian.gaussians import Gaussians
from ..image.color import rgb_to_ycbcr, to_coded
from ..image.io import check_image
from ..image.metrics import MAX_PSNR, psnr_from_mse
from ..raster.render import render
from .egs import MAX_SECTIONS, SUFFIX, EgsContent, to_bytes, write
from .error_feedback import quantize_with_feedback, to_gaussians
from .quantization import Steps

Array = NDArray[np.floating]

BUDGET = 0.5
"""Decibels that a file may lose by default: beyond, more bits are saved by fewer splats."""

MSE_WITHOUT_IMAGE = 1e-4
"""Mean squared error, 40 dB, that a set is taken to have where its image is not given."""

MIN_MSE = 1e-9
"""Mean squared error, 90 dB, below which nothing is gained by less."""

PROBE_STEPS = Steps(mean=0.1, scale=0.08, stretch=0.06, color=0.125)
"""Steps at which the errors of one kind are measured; that of colours times their root mean
square in units of one over the size."""

MAX_STEPS = Steps(mean=4.0, scale=1.0, stretch=1.0, color=1.0)
"""Largest steps, in the same units: what does not show at any step would have none."""

NEGLIGIBLE = 1 / 32
"""Share of a step at which errors are a thousandth."""

HALVINGS = 4
"""Halvings of the interval of the common factor, of which the ends differ by a root of 2: the last
one is worth 0.04 bits a number."""

TOO_FINE = "pack: no rounding is fine enough for the budget; allow more dB"

_Candidate = tuple[EgsContent, float]


class PackResult(NamedTuple):
    """Result of `pack`.

    Attributes
    ----------
    gaussians : Gaussians
        What the file holds: the rounded set, its splats in the order of the file.
    bytes : int
    bits_per_pixel : float
        Of the native size.
    psnr : float
        Decibels, in the space of the budget, of its rendering against the image; where none was
        given, against the rendering of the set before.
    psnr_drop : float
        Decibels below what the set had before; for want of an image, below 40 dB.
    steps : Steps
    """

    gaussians: Gaussians
    bytes: int
    bits_per_pixel: float
    psnr: float
    psnr_drop: float
    steps: Steps


def pack(
    gaussians: Gaussians,
    path: str | os.PathLike[str],
    image: ArrayLike | None = None,
    budget: float = BUDGET,
    sections: Sequence[int] | None = None,
    cutoff: float | None = None,
) -> PackResult:
    """Write the smallest ``.egs`` file of a set that keeps its quality but for a budget.

    Parameters
    ----------
    gaussians : Gaussians
    path : path-like
        Replaced, all or nothing. `Gaussians.load` reads it.
    image : array_like, shape (H, W, 3), (H, W, 1) or (H, W), optional
        The image that the set was fitted to, as `fit` takes it. By default the rendering of the
        set.
    budget : float, optional
        Decibels of PSNR that may be lost, above 0 and at most 100: against the image, in
        the space of the set (psnr_ycbcr where that is YCbCr; light is coded as sRGB), at its native
        size. Without the image, what a set of 40 dB loses where the errors add.
    sections : sequence of int, optional
        Numbers of splats in each part of the file, in the order of the set; readers may stop after
        any of them, and the budget holds for what they have then. By default all in one. Inside a
        section splats lie in the order of the curve.
    cutoff : float, optional
        Standard deviations after which a Gaussian ends; by default that of the set.

    Returns
    -------
    Receipt

    Raises
    ------
    ValueError
        If the image or an argument does not fit the set, the file has another suffix than ``.egs``,
        or no file holds the budget.
    OSError
        If the file cannot be written; an existing one is then as before.

    Notes
    -----
    The result is a function of the arguments, bit for bit, on one machine and backend.
    """
    if Path(path).suffix.lower() != SUFFIX:
        raise ValueError(f"{path}: packed sets end in {SUFFIX}; choose such a name, or use save()")
    rows = _rows(len(gaussians), sections)
    if not 0 < budget <= MAX_PSNR:
        raise ValueError(
            f"pack: budget is {budget}; it must be above 0 and at most {MAX_PSNR:g} dB, such as 0.5"
        )
    gaussians = dr.detach(gaussians)
    if cutoff is not None:
        gaussians = replace(gaussians, cutoff=float(cutoff))
    shown = _shown(gaussians) if image is None else _compared(gaussians, image)
    # The best light for an image is not the best picture: a set that has found it is kept.
    keeps = image is None or gaussians.space == "linear"
    target = _planes_of(gaussians) if keeps else shown
    unseen = MSE_WITHOUT_IMAGE if image is None else 0

    def errors(found: Gaussians) -> list[float]:
        parts = [*(found[: r.stop] for r in rows[:-1]), found]
        return [_error(part, shown) for part in parts]

    before = [max(error + unseen, MIN_MSE) for error in errors(gaussians)]
    limits = [error * 10 ** (budget / 10) - unseen for error in before]
    if min(limits) <= 0:
        raise ValueError(TOO_FINE)

    def attempt(steps: Steps) -> _Candidate:
        packed = quantize_with_feedback(gaussians, target, steps, rows)
        after = zip(errors(to_gaussians(packed, gaussians)), limits, strict=True)
        # Of all that a reader may stop at the worst counts, on the scale of the whole.
        return packed, max(error * (limits[-1] / limit) for error, limit in after)

    start = _water_fill(attempt, gaussians, limits[-1])
    packed, _ = _search(attempt, start, limits[-1])
    error = errors(to_gaussians(packed, gaussians))[-1]
    content = to_bytes(packed)
    write(path, content)
    return PackResult(
        gaussians=Gaussians.load(path, types_of(gaussians.mean).backend),
        bytes=len(content),
        bits_per_pixel=8 * len(content) / (gaussians.width * gaussians.height),
        psnr=psnr_from_mse(error),
        psnr_drop=psnr_from_mse(before[-1]) - psnr_from_mse(error + unseen),
        steps=packed.steps,
    )


def _water_fill(
    attempt: Callable[[Steps], _Candidate], gaussians: Gaussians, limit: float
) -> Steps:
    """Steps of equal marginal cost whose errors, were they squares, would reach the limit."""
    arrays = gaussians.to_arrays()
    size = sizes_from_log_shapes(log_shapes(arrays["factor"]))
    spread = float(np.sqrt(np.mean(np.square(arrays["color"] * size[:, None]))))
    unit = np.array([1, 1, 1, max(spread, 1e-6)])
    probe, numbers = np.array(PROBE_STEPS) * unit, np.array([2, 1, 2, gaussians.channels])
    fine = probe * NEGLIGIBLE
    start = attempt(_steps(fine))[1]
    errors = [attempt(_steps(np.where(np.arange(4) == k, probe, fine)))[1] for k in range(4)]
    cost = np.maximum(np.array(errors) - start, 1e-6 * limit) / probe**2
    room = max(limit - start, 0.1 * limit)
    steps = np.sqrt(room / numbers.sum() * numbers / cost)
    return _steps(np.minimum(steps, np.array(MAX_STEPS) * unit))


def _search(attempt: Callable[[Steps], _Candidate], steps: Steps, limit: float) -> _Candidate:
    """Find the largest common factor of the steps whose error is within the limit."""

    def scaled(power: float) -> _Candidate:
        return attempt(_steps(np.array(steps) * 2**power))

    power, best = 0.0, scaled(0.0)
    if best[1] <= limit:
        while power < 4 and (wider := scaled(power + 0.5))[1] <= limit:
            power, best = power + 0.5, wider
    else:
        while best[1] > limit:
            power -= 0.5
            if power < -12:
                raise ValueError(TOO_FINE)
            best = scaled(power)
    for k in range(HALVINGS):
        tried = scaled(power + 0.5 ** (k + 2))
        if tried[1] <= limit:
            power, best = power + 0.5 ** (k + 2), tried
    return best


def _steps(values: Array) -> Steps:
    """Steps as a file holds them."""
    return Steps(*np.asarray(values, np.float32).tolist())


def _rows(count: int, sections: Sequence[int] | None) -> list[slice]:
    """The splats of each section."""
    counts = [count] if sections is None else [int(k) for k in sections]
    if not counts or min(counts) < 1 or sum(counts) != count or len(counts) > MAX_SECTIONS:
        raise ValueError(
            f"pack: sections are {counts[:8]}, expected 1 to {MAX_SECTIONS} numbers of splats "
            f"above 0 whose sum is {count}"
        )
    ends = np.cumsum(counts).tolist()
    return [slice(end - k, end) for end, k in zip(ends, counts, strict=True)]


def _compared(gaussians: Gaussians, image: ArrayLike) -> Array:
    """The image in the space in which it is compared: that of the set, light coded as sRGB."""
    pixels = check_image(image, keep_grey=gaussians.channels == 1)
    expected = (gaussians.height, gaussians.width, gaussians.channels)
    if pixels.shape != expected:
        raise ValueError(f"pack: image has shape {pixels.shape}, the set needs {expected}")
    return rgb_to_ycbcr(pixels) if gaussians.space == "ycbcr" else pixels


def _shown(gaussians: Gaussians) -> Array:
    """Render a set in the space in which it is compared."""
    planes = _planes_of(gaussians)
    return to_coded(np.maximum(planes, 0)) if gaussians.space == "linear" else planes


def _planes_of(gaussians: Gaussians) -> Array:
    """Render the channels of a set as they are."""
    return render(replace(gaussians, space="data")).numpy()


def _error(gaussians: Gaussians, shown: Array) -> float:
    return float(np.mean(np.square(_shown(gaussians) - shown, dtype=np.float64)))

"""The weights of a probability model: fitting them in the encoder, and storing them in files."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ..backend.types import Doubles, Integers
from ..storage.npz import BadValue
from .exact_math import in_order
from .range_coder import TAILS

MIN_WIDTH = 0.1
"""Smallest width of a distribution, in steps."""

WIDTH_FACTORS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2)
"""Factors of the mean absolute error that are tried as the width."""

CLASSES = 15
"""Number of classes of directions, see `Directions` in `eigengs_dr.codec.gaussian_model`."""

MIN_RICH_COUNT = 1500
"""Number of Gaussians below which all weights may take more bytes than they save."""


class Weights(NamedTuple):
    """The prediction of one kind of numbers.

    Attributes
    ----------
    center, width : ndarray of float64
        Weights of the features, see `eigengs_dr.codec.gaussian_model`.
    tails : int
        One of `eigengs_dr.codec.range_coder.TAILS`.
    """

    center: Doubles
    width: Doubles
    tails: int


@dataclass
class Model:
    """All parameters that a section stores besides the integers.

    Attributes
    ----------
    weights : list of Weights
        For each channel, for the scale, and for the stretch.
    sharpness : ndarray of int64, shape (CLASSES,)
        Concentration of directions around those of the neighbours, from 0 to 255.
    """

    weights: list[Weights] = field(default_factory=list)
    sharpness: Integers = field(default_factory=lambda: np.zeros(CLASSES, np.int64))


def feature_counts(channels: int) -> list[tuple[int, int]]:
    """Return the number of features of the centre and of the width, for each `Weights`."""
    colors = [(1 + 2 * min(k, 2), 4 + 2 * min(k, 2)) for k in range(channels)]
    return [*colors, (7, 2), (5, 2)]


def fit_weights(
    center: Doubles, width: Doubles, values: Doubles, step: Doubles, rich: bool = True
) -> Weights:
    """Return weights with which the numbers take few bits.

    Parameters
    ----------
    center, width : ndarray, shape (N, F)
        Features of the centre and of the width of each distribution.
    values, step : ndarray, shape (N,)
        The numbers, which are multiples of the steps.
    rich : bool, optional
        Whether all weights may differ from 0, or only the first one of each.
    """
    width_weights, deviation = np.zeros(width.shape[1]), np.maximum(step, 1e-9)
    used = slice(None) if rich else slice(0, 1)
    center_weights = np.zeros(center.shape[1])
    for _ in range(3):
        scaled = center[:, used] / deviation[:, None]
        ridge = 1e-3 * len(values) ** 0.5 * np.eye(scaled.shape[1])
        known = np.append(values / deviation, np.zeros(len(ridge)))
        solution = np.linalg.lstsq(np.vstack([scaled, ridge]), known, rcond=None)[0]
        center_weights[used] = stored_center(solution)
        error = values - in_order(center_weights[:, None] * center.T)
        width_weights[used] = _fit_width(width[:, used], np.abs(error) + 0.1 * step, deviation)
        deviation = np.maximum(in_order(width_weights[:, None] * width.T), MIN_WIDTH * step)
    trials = [(w, tails) for tails in TAILS for w in WIDTH_FACTORS]
    best = min(trials, key=lambda trial: _bits(error / step, trial[0] * deviation / step, trial[1]))
    return Weights(center_weights, stored_width(width_weights * best[0]), best[1])


def _fit_width(features: Doubles, error: Doubles, deviation: Doubles) -> Doubles:
    """Return non-negative weights of features whose weighted sum approximates absolute errors."""
    from scipy.optimize import nnls  # imported here, because decoders do not need it

    return np.asarray(nnls(features / deviation[:, None], error / deviation)[0])


def _bits(error: Doubles, width: Doubles, tails: int) -> float:
    """Estimate the bits that errors, in steps, take with a distribution."""
    t = error / width
    density = np.log2(width) + 0.5 * (tails + 1) * np.log2(1 + t * t / tails)
    return float(density.sum()) + len(t) * {2: 1.5, 4: 1.415, 8: 1.369}[tails]


def stored_center(weights: Doubles) -> Doubles:
    """Round weights to half precision, as in files."""
    return np.clip(np.nan_to_num(weights), -6e4, 6e4).astype(np.float16).astype(np.float64)


def stored_width(weights: Doubles) -> Doubles:
    """Round positive weights to half precision with a mantissa of two bits, as in files."""
    half = np.clip(np.nan_to_num(weights), 0, 4e4).astype("<f2").view("<u2")
    return ((half + 0x80) & 0xFF00).astype("<u2").view("<f2").astype(np.float64)


def to_bytes(model: Model, rich: bool) -> bytes:
    """Return the bytes of a model; if it is not rich, only of the first weights."""
    used, parts = slice(None) if rich else slice(0, 1), list[bytes]()
    for weights in model.weights:
        high = weights.width[used].astype("<f2").view("<u2") >> 8
        parts.append(bytes([TAILS.index(weights.tails)]))
        parts += [weights.center[used].astype("<f2").tobytes(), high.astype(np.uint8).tobytes()]
    if rich:
        parts.append(model.sharpness.astype(np.uint8).tobytes())
    return b"".join(parts)


def from_bytes(data: bytes, channels: int, rich: bool) -> tuple[Model, bytes]:
    """Return a model and the bytes after it; the bytes need not be trusted."""
    model = Model()

    def take(count: int) -> bytes:
        nonlocal data
        if count > len(data):
            raise BadValue("the weights are truncated")
        taken, data = data[:count], data[count:]
        return taken

    for numbers in feature_counts(channels):
        used = numbers if rich else (1, 1)
        [tails] = take(1)
        if tails >= len(TAILS):
            raise BadValue("the weights name an unknown distribution")
        center, width = np.zeros(numbers[0]), np.zeros(numbers[1])
        center[: used[0]] = np.frombuffer(take(2 * used[0]), "<f2")
        high = np.frombuffer(take(used[1]), np.uint8).astype("<u2") << 8
        width[: used[1]] = high.view("<f2")
        model.weights.append(Weights(center, width, TAILS[tails]))
    if rich:
        model.sharpness = np.frombuffer(take(CLASSES), np.uint8).astype(np.int64)
    return model, data

"""The weights of a probability model: fitting them in the encoder, and storing them in files."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..backend.types import Doubles
from ..storage.npz import BadValue
from .exact_math import in_order

MIN_WIDTH = 0.1
"""Smallest width of a distribution, in steps."""

MIN_RICH_COUNT = 1500
"""Number of Gaussians below which all weights may take more bytes than they save."""


class Weights(NamedTuple):
    """The prediction of one kind of numbers.

    Attributes
    ----------
    center, width : ndarray of float64
        Weights of the features, see `eigengs_dr.codec.gaussian_model`.
    """

    center: Doubles
    width: Doubles


def feature_counts(channels: int) -> list[tuple[int, int]]:
    """Return the number of features of the centre and of the width, for each `Weights`.

    These are of the channels, the scale and the stretch.
    """
    colors = [(1 + 2 * min(k, 2), 2 + 2 * min(k, 2)) for k in range(channels)]
    return [*colors, (4, 2), (4, 2)]


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
    return Weights(center_weights, stored_width(width_weights))


def _fit_width(features: Doubles, error: Doubles, deviation: Doubles) -> Doubles:
    """Return non-negative weights of features whose weighted sum approximates absolute errors."""
    from scipy.optimize import nnls  # imported here, because decoders do not need it

    return np.asarray(nnls(features / deviation[:, None], error / deviation)[0])


def stored_center(weights: Doubles) -> Doubles:
    """Round weights to half precision, as in files."""
    return np.clip(np.nan_to_num(weights), -6e4, 6e4).astype(np.float16).astype(np.float64)


def stored_width(weights: Doubles) -> Doubles:
    """Round positive weights to half precision with a mantissa of two bits, as in files."""
    half = np.clip(np.nan_to_num(weights), 0, 4e4).astype("<f2").view("<u2")
    return ((half + 0x80) & 0xFF00).astype("<u2").view("<f2").astype(np.float64)


def to_bytes(weights: list[Weights], rich: bool) -> bytes:
    """Return the bytes of the weights; if they are not rich, only of the first ones."""
    used, parts = slice(None) if rich else slice(0, 1), list[bytes]()
    for center, width in weights:
        high = width[used].astype("<f2").view("<u2") >> 8
        parts += [center[used].astype("<f2").tobytes(), high.astype(np.uint8).tobytes()]
    return b"".join(parts)


def from_bytes(data: bytes, channels: int, rich: bool) -> tuple[list[Weights], bytes]:
    """Return weights and the bytes after them; the bytes need not be trusted."""
    found = []
    for numbers in feature_counts(channels):
        centers, widths = numbers if rich else (1, 1)
        if 2 * centers + widths > len(data):
            raise BadValue("the weights are truncated")
        center, width = np.zeros(numbers[0]), np.zeros(numbers[1])
        center[:centers] = np.frombuffer(data, "<f2", centers)
        high = np.frombuffer(data, np.uint8, widths, 2 * centers).astype("<u2") << 8
        width[:widths] = high.view("<f2")
        found.append(Weights(center, width))
        data = data[2 * centers + widths :]
    return found, data

"""Factors from matrix logarithms, in double precision: the oracle of the codec."""

import numpy as np


def factors_from_log_shapes(shape):
    """Return a, b, c of s, u, v: the inverse of `eigengs_dr.codec.quantization.log_shapes`."""
    s, u, v = np.asarray(shape, np.float64).T
    length, angle = np.hypot(u, v), np.arctan2(v, u)
    # F^T F / exp(2 s) = cosh(2 length) + sinh(2 length) [[cos, sin], [sin, -cos]] of the angle.
    # The form of a below avoids the cancellation of digits in cosh + sinh cos.
    odd = np.sinh(2 * length)
    a = np.sqrt(np.exp(-2 * length) + 2 * odd * np.cos(0.5 * angle) ** 2)
    return np.stack([a, odd * np.sin(angle) / a, 1 / a], axis=1) * np.exp(s)[:, None]

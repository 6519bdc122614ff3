"""Elementary functions whose results are bit-identical on every machine.

The decoder of a range coder must compute exactly the same numbers as the encoder. Mathematical
libraries round exponentials and angles differently. The functions here use only sums, products,
quotients, square roots and shifts of exponents, which IEEE 754 rounds correctly everywhere.
"""

from __future__ import annotations

import numpy as np

from ..backend.types import Doubles

_EXP2 = (
    1.0,
    0.6931471805599453,
    0.24022650695910072,
    0.05550410866482158,
    0.009618129107628477,
    0.0013333558146428443,
    0.00015403530393381608,
    1.5252733804059841e-05,
    1.3215486790144307e-06,
    1.0178086009239699e-07,
)
"""Taylor coefficients of ``2^x``: the powers of ln 2 over the factorials."""

_SIN = (
    6.283185307179586,
    -41.341702240399755,
    81.60524927607504,
    -76.70585975306136,
    42.058693944897655,
    -15.094642576822984,
    3.8199525848482823,
)
"""Taylor coefficients of ``sin(2 pi x) / x`` in ``x^2``."""


def sum_in_order(rows: Doubles) -> Doubles:
    """Return the sum of rows (K, n), added one after another, which libraries do not guarantee."""
    total = np.zeros(rows.shape[1])
    for row in rows:
        total = total + row
    return total


def exp2(x: Doubles) -> Doubles:
    """Return ``2^x`` with a relative error of 1e-11; x is clipped to +-1000."""
    x = np.clip(x, -1000.0, 1000.0)
    integer = np.rint(x)
    return np.ldexp(_polynomial(_EXP2, x - integer), integer.astype(np.int32))


def log2(x: Doubles) -> Doubles:
    """Return the base-2 logarithm of positive numbers with an error of 1e-10."""
    mantissa, exponent = np.frexp(x)
    low = mantissa < 0.7071067811865476
    mantissa, exponent = np.where(low, 2 * mantissa, mantissa), exponent - low
    t = (mantissa - 1) / (mantissa + 1)  # ln m = 2 (t + t^3 / 3 + t^5 / 5 + ...)
    series = _polynomial([1 / (2 * k + 1) for k in range(6)], t * t)
    return exponent + 2.8853900817779268 * t * series  # 2 / ln 2


def sin_turns(x: Doubles) -> Doubles:
    """Return ``sin(2 pi x)`` with an error of 1e-8."""
    x = x - np.rint(x)
    x = np.where(np.abs(x) > 0.25, np.copysign(0.5, x) - x, x)
    return x * _polynomial(_SIN, x * x)


def cos_turns(x: Doubles) -> Doubles:
    """Return ``cos(2 pi x)`` with an error of 1e-8."""
    return sin_turns(x + 0.25)


def angle_in_turns(y: Doubles, x: Doubles) -> Doubles:
    """Return the angle of (x, y) in turns, in [-0.5, 0.5], with an error of 1e-10."""
    larger, smaller = np.maximum(np.abs(x), np.abs(y)), np.minimum(np.abs(x), np.abs(y))
    t = smaller / np.where(larger > 0, larger, 1.0)
    for _ in range(2):  # tan(a / 2) from tan(a), twice
        t = t / (1 + np.sqrt(1 + t * t))
    terms = [(-1) ** k / (2 * k + 1) for k in range(12)]  # for t up to tan(pi / 16)
    angle = 4 * 0.15915494309189535 * t * _polynomial(terms, t * t)  # 1 / (2 pi)
    angle = np.where(np.abs(y) > np.abs(x), 0.25 - angle, angle)
    angle = np.where(x < 0, 0.5 - angle, angle)
    return np.where(y < 0, -angle, angle)


def _polynomial(coefficients: tuple[float, ...] | list[float], x: Doubles) -> Doubles:
    """Return ``sum_k c_k x^k`` by Horner's rule."""
    total = np.full(np.shape(x), coefficients[-1])
    for c in coefficients[-2::-1]:
        total = total * x + c
    return total

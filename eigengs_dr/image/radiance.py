"""Codes of light that may exceed 1: logarithms to compute with, PU21 to compare by."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

LOG_SLOPE = 100.0
"""Factor of light in `to_log`. With 5,000 Gaussians and 300 steps, three made-up environments of
512x256 pixels end at 33.2, 35.0, 36.9, 37.9, 38.3, 38.4 and 38.4 dB in PU21 for 1, 3, 10, 30, 100,
300 and 1,000."""

PU21_WHITE = 100.0
"""Luminance of light of 1, in cd/m^2, for `to_pu21`: that of a common display."""

PU21_RANGE = (0.005, 10_000.0)
"""Luminances that PU21 knows, in cd/m^2."""

_PU21 = (0.353487901, 0.3734658629, 8.277049286e-05, 0.9062562627, 0.09150303166, 0.9099517204)


def to_log(light: NDArray[Any]) -> NDArray[Any]:
    """Encode light above 0 by logarithms: ``log(1 + 100 I) / log(101)``, so that 1 stays 1.

    Below 0 the code goes on as a straight line.

    Parameters
    ----------
    light : ndarray of float32 or float64, any shape

    Returns
    -------
    ndarray, same shape and dtype

    References
    ----------
    The mu-law of N. K. Kalantari, R. Ramamoorthi: Deep high dynamic range imaging of dynamic
    scenes. ACM Transactions on Graphics 36(4), 2017, equation 9, with another constant.

    Examples
    --------
    >>> to_log(np.array([0.0, 0.1, 1.0, 5000.0])).round(2)
    array([0.  , 0.52, 1.  , 2.84])
    """
    coded = np.log1p(LOG_SLOPE * np.maximum(light, 0)) + LOG_SLOPE * np.minimum(light, 0)
    return np.asarray(coded / math.log1p(LOG_SLOPE), light.dtype)


def from_log(codes: Any) -> Any:
    """Decode `to_log`; negative codes give light above -0.01.

    Parameters
    ----------
    codes : NumPy or Dr.Jit array of floats, any shape

    Returns
    -------
    array, same shape and type
        Light, with finite derivatives for finite results.
    """
    factor = math.log1p(LOG_SLOPE)
    if isinstance(codes, np.ndarray):
        return np.asarray(np.expm1(factor * codes) / LOG_SLOPE, codes.dtype)
    import drjit as dr  # loads libLLVM

    return (dr.exp2(codes * (factor / math.log(2))) - 1) * (1 / LOG_SLOPE)


def to_pu21(light: NDArray[Any]) -> NDArray[Any]:
    """Encode linear light so that equal differences are about equally visible, also above 1.

    The code is logarithmic in bright light and nearly linear in the dark. Light is clamped to
    [5e-5, 100].

    Parameters
    ----------
    light : ndarray of float32 or float64, any shape
        Linear light; 1 is a luminance of `PU21_WHITE`.

    Returns
    -------
    ndarray, same shape and dtype
        Codes from 0 to 2.3; 1 for light of 1.

    References
    ----------
    R. K. Mantiuk, M. Azimi: PU21: A novel perceptually uniform encoding for adapting existing
    quality metrics for HDR. Picture Coding Symposium, 2021; the curve "banding and glare", whose
    constants are those of the authors' program. Its codes are divided by that of white, 256.

    Examples
    --------
    >>> to_pu21(np.array([0.0, 0.2, 1.0, 50.0])).round(2)
    array([0.  , 0.62, 1.  , 2.12])
    """
    p1, p2, p3, p4, p5, p6 = _PU21
    power = np.clip(light * PU21_WHITE, *PU21_RANGE) ** p4
    codes = ((p1 + p2 * power) / (1 + p3 * power)) ** p5 - p6
    white = ((p1 + p2 * PU21_WHITE**p4) / (1 + p3 * PU21_WHITE**p4)) ** p5 - p6
    return np.asarray(codes / white, light.dtype)

"""Conversions of colour: sRGB, studio-range YCbCr of ITU-R BT.601, linear light, and its codes.

Light that may exceed 1 is encoded by logarithms for fitting, and by PU21 for comparisons. A unit
vector n is stored as ``(n + 1) / 2``, as in files of normal maps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Samples = Any
"""NumPy or Python floats, or a flat, nested or tensor array of Dr.Jit floats; no single type
supports all operations of a function."""

Function = Callable[..., Samples]

FloatImage = NDArray[np.floating]
"""A NumPy array of floats."""

MAX_CHANNELS = 64
"""Largest number of channels: a program keeps the sums of all channels of a tile in registers."""

RGB_TO_YCBCR: NDArray[np.float64] = (
    np.array(
        [
            [65.481, 128.553, 24.966],
            [-37.797, -74.203, 112.0],
            [112.0, -93.786, -18.214],
        ]
    )
    / 255
)
"""Matrix M, shape (3, 3), of ``ycbcr = M rgb + YCBCR_OFFSET``; rows Y, Cb, Cr (ITU-R BT.601)."""

YCBCR_OFFSET: NDArray[np.float64] = np.array([16.0, 128.0, 128.0]) / 255
"""YCbCr of black, shape (3,)."""

YCBCR_TO_RGB: FloatImage = np.linalg.inv(RGB_TO_YCBCR)
"""Inverse of `RGB_TO_YCBCR`, shape (3, 3)."""


def rgb_to_ycbcr(image: FloatImage) -> FloatImage:
    """Convert RGB to studio-range YCbCr / 255.

    For RGB in [0, 1], Y lies in [16, 235] / 255, and Cb and Cr lie in [16, 240] / 255. Values are
    not clamped, so the conversion is affine and invertible everywhere.

    Parameters
    ----------
    image : ndarray of float32 or float64, shape (..., 3)
        Gamma-encoded RGB, 1 is white.

    Returns
    -------
    ndarray, same shape and dtype
        Y, Cb, Cr, equal to ``skimage.color.rgb2ycbcr(image) / 255``.

    Raises
    ------
    ValueError
        If the last axis is not 3 or the dtype is not float32 or float64.

    Examples
    --------
    >>> rgb_to_ycbcr(np.ones(3)).round(4)
    array([0.9216, 0.502 , 0.502 ])
    """
    image = np.asarray(image)
    if image.shape[-1:] != (3,):
        raise ValueError(f"image has shape {image.shape}; expected (..., 3)")
    _functions(image)  # rejects bytes, which would be taken for values in [0, 1]
    result = image @ RGB_TO_YCBCR.T.astype(image.dtype)
    result += YCBCR_OFFSET.astype(image.dtype)
    return result


def to_linear(coded: Samples) -> Samples:
    """Decode sRGB to linear light: ``x / 12.92``, above 0.04045 ``((x + 0.055) / 1.055)^2.4``.

    The function works elementwise and keeps the precision. Values and derivatives are finite
    everywhere, also outside [0, 1].

    Parameters
    ----------
    coded : NumPy or Dr.Jit array of floats, any shape
        sRGB, 1 is white. Dr.Jit vectors, colours and tensors are accepted too.

    Returns
    -------
    array, same shape and type
        Linear light, 1 is white.

    Raises
    ------
    ValueError
        If a NumPy array is not float32 or float64.

    References
    ----------
    IEC 61966-2-1:1999, section 5.2.

    Examples
    --------
    >>> to_linear(np.array([0.0, 0.5, 1.0])).round(4)
    array([0.   , 0.214, 1.   ])
    """
    select, maximum, power = _functions(coded)
    # Clamping avoids infinite slopes and NaN in the power: in reverse mode, zero times these is
    # NaN.
    curved = power((maximum(coded, 0.04045) + 0.055) * (1 / 1.055), 2.4)
    return select(coded <= 0.04045, coded * (1 / 12.92), curved)


def to_coded(linear: Samples) -> Samples:
    """Encode linear light as sRGB: ``12.92 x``, above 0.0031308 ``1.055 x^(1 / 2.4) - 0.055``.

    This is the inverse of `to_linear`. With the constants of the standard, there is a step of 3e-8
    between the two branches.

    Parameters
    ----------
    linear : NumPy or Dr.Jit array of floats, any shape
        Linear light, 1 is white.

    Returns
    -------
    array, same shape and type
        sRGB, 1 is white. Values are not clamped: negative light gives negative codes.

    Raises
    ------
    ValueError
        If a NumPy array is not float32 or float64.
    """
    select, maximum, power = _functions(linear)
    curved = power(maximum(linear, 0.0031308), 1 / 2.4) * 1.055 - 0.055
    return select(linear <= 0.0031308, linear * 12.92, curved)


def exposed(pixels: FloatImage, exposure: float) -> FloatImage:
    """Multiply the light of sRGB pixels."""
    return pixels if exposure == 1 else to_coded(to_linear(pixels) * np.float32(exposure))


def slope_to_linear(coded: Samples) -> Samples:
    """Return the derivative of `to_linear`, elementwise."""
    select, maximum, power = _functions(coded)
    curved = 2.4 / 1.055 * power((maximum(coded, 0.04045) + 0.055) * (1 / 1.055), 1.4)
    return select(coded <= 0.04045, 1 / 12.92, curved)


def clamp(values: Samples, largest: float = 1.0) -> Samples:
    """Clamp values to [0, largest]; derivatives of Dr.Jit arrays ignore it.

    Parameters
    ----------
    values : NumPy or Dr.Jit array of floats, any shape
    largest : float, optional
        It may be infinite.
    """
    if isinstance(values, np.ndarray):
        return np.clip(values, 0, largest)
    import drjit as dr  # loads libLLVM

    clamped = dr.maximum(values, 0) if math.isinf(largest) else dr.clip(values, 0, largest)
    return dr.replace_grad(clamped, values)


def _functions(array: Samples) -> tuple[Function, Function, Function]:
    """Return select, maximum and power for a NumPy or Dr.Jit array; reject NumPy integers."""
    if not isinstance(array, np.ndarray | np.generic | float):
        import drjit as dr  # loads libLLVM

        return dr.select, dr.maximum, dr.power
    dtype = np.asarray(array).dtype
    if dtype not in (np.float32, np.float64):
        raise ValueError(f"array is {dtype}; convert to float32 or float64 in [0, 1] first")
    return np.where, np.maximum, np.power


LOG_SLOPE = 100.0
"""Factor of light in `to_log`. With 5,000 Gaussians and 300 steps, three synthetic environments of
512x256 pixels reach 33.2, 35.0, 36.9, 37.9, 38.3, 38.4 and 38.4 dB in PU21 for 1, 3, 10, 30, 100,
300 and 1,000."""

PU21_WHITE = 100.0
"""Luminance of the value 1, in cd/m^2, for `to_pu21`: that of a common display."""

PU21_RANGE = (0.005, 10_000.0)
"""Range of luminances of PU21, in cd/m^2."""

_PU21 = (0.353487901, 0.3734658629, 8.277049286e-05, 0.9062562627, 0.09150303166, 0.9099517204)


def to_log(light: FloatImage) -> FloatImage:
    """Encode light above 0 by a logarithm: ``log(1 + 100 I) / log(101)``, so that 1 stays 1.

    Below 0 the code continues as a straight line.

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


def from_log(codes: Samples) -> Samples:
    """Decode `to_log`; negative codes give light above -0.01.

    Parameters
    ----------
    codes : NumPy or Dr.Jit array of floats, any shape

    Returns
    -------
    array, same shape and type
        Light; at most 2^126 for finite codes.
    """
    factor = math.log1p(LOG_SLOPE)
    if isinstance(codes, np.ndarray):
        exponent = np.minimum(factor * codes, 126 * math.log(2))
        return np.asarray(np.expm1(exponent) / LOG_SLOPE, codes.dtype)
    import drjit as dr  # loads libLLVM

    return (dr.exp2(dr.minimum(codes * (factor / math.log(2)), 126)) - 1) * (1 / LOG_SLOPE)


def to_pu21(light: Samples) -> Samples:
    """Encode linear light, also above 1, so that equal differences are about equally visible.

    The code is logarithmic for bright light and nearly linear for dark light. Light is clamped to
    [5e-5, 100].

    Parameters
    ----------
    light : NumPy or Dr.Jit array of floats, any shape
        Linear light; 1 is the luminance `PU21_WHITE`.

    Returns
    -------
    array, same shape and type
        Codes from 0 to 2.3; the code of 1 is 1.

    References
    ----------
    R. K. Mantiuk, M. Azimi: PU21: A novel perceptually uniform encoding for adapting existing
    quality metrics for HDR. Picture Coding Symposium, 2021; the curve "banding and glare", with the
    constants of the authors' program. Its codes are divided by the code of white, 256.

    Examples
    --------
    >>> to_pu21(np.array([0.0, 0.2, 1.0, 50.0])).round(2)
    array([0.  , 0.62, 1.  , 2.12])
    """
    p1, p2, p3, p4, p5, p6 = _PU21
    select, maximum, raise_to = _functions(light)
    low, high = PU21_RANGE
    light = maximum(light * PU21_WHITE, low)
    power = raise_to(select(light > high, high, light), p4)
    codes = ((p1 + p2 * power) / (1 + p3 * power)) ** p5 - p6
    white = ((p1 + p2 * PU21_WHITE**p4) / (1 + p3 * PU21_WHITE**p4)) ** p5 - p6
    return codes / white


MIN_SQUARED_LENGTH = 1e-6
"""Squared length below which a vector counts as having no direction, and stays nearly zero."""


def by_channel(convert: Callable[[list], list], pixels: Samples) -> Samples:
    """Convert the three channels of a Dr.Jit tensor (H, W, 3) by a function of them."""
    import drjit as dr  # loads libLLVM

    flat = pixels.array
    Float, UInt = type(flat), dr.uint32_array_t(type(flat))
    # Gathers, because slices of tensors compile a program for every size.
    index = dr.arange(UInt, dr.width(flat))
    axis = index % 3
    x, y, z = convert([dr.gather(Float, flat, index - axis + k) for k in range(3)])
    return type(pixels)(dr.select(axis == 0, x, dr.select(axis == 1, y, z)), pixels.shape)


def unit_codes(channels: Sequence[Samples]) -> list[Samples]:
    """Scale the vectors of a normal map to unit length.

    Parameters
    ----------
    channels : sequence of 3 NumPy or Dr.Jit arrays
        Codes of x, y and z; 0.5 encodes the component 0.

    Returns
    -------
    list of arrays
        Codes of unit vectors.
    """
    vector = [2 * channel - 1 for channel in channels]
    square = sum((v * v for v in vector[1:]), vector[0] * vector[0])
    if isinstance(square, np.ndarray):
        scale = 0.5 / np.sqrt(np.maximum(square, MIN_SQUARED_LENGTH))
    else:
        import drjit as dr

        from ..backend.arrays import rsqrt

        scale = 0.5 * rsqrt(dr.maximum(square, MIN_SQUARED_LENGTH))
    return [v * scale + 0.5 for v in vector]

"""Colour spaces: gamma-encoded RGB, studio-range YCbCr of ITU-R BT.601, linear light."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .normals import renormalize
from .radiance import from_log

SPACES = ("ycbcr", "rgb", "linear", "data", "radiance", "log", "normal")
"""Names of the colour spaces that the channels of a set of Gaussians may have.

``"ycbcr"`` is studio-range YCbCr / 255, ``"rgb"`` is gamma-encoded RGB, ``"linear"`` is linear RGB,
``"radiance"`` is linear RGB that may exceed 1, ``"log"`` is logarithms of it (see
`eigengs_dr.image.radiance`), ``"normal"`` is a normal map (see `eigengs_dr.image.normals`), and
``"data"`` is anything else (roughness, heights, ...), with any number of channels.
"""

LIGHT = ("linear", "radiance")
"""Spaces in which Gaussians sum to linear light."""

UNBOUNDED = ("radiance", "log")
"""Spaces of light that may exceed 1."""

MAX_CHANNELS = 64
"""Largest number of channels: a program holds the sums of all channels of a tile in registers."""

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

YCBCR_TO_RGB: NDArray[np.floating[Any]] = np.linalg.inv(RGB_TO_YCBCR)
"""Inverse of `RGB_TO_YCBCR`, shape (3, 3)."""


def rgb_to_ycbcr(image: NDArray[Any]) -> NDArray[Any]:
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
    image = _check_rgb(image)
    result = image @ RGB_TO_YCBCR.T.astype(image.dtype)
    result += YCBCR_OFFSET.astype(image.dtype)
    return result


def ycbcr_to_rgb(image: NDArray[Any]) -> NDArray[Any]:
    """Convert studio-range YCbCr / 255 to RGB, the inverse of `rgb_to_ycbcr`.

    Parameters
    ----------
    image : ndarray of float32 or float64, shape (..., 3)
        Y, Cb, Cr on a [0, 1] scale.

    Returns
    -------
    ndarray, same shape and dtype
        RGB, 1 is white. Values are not clamped: many YCbCr triples lie outside the RGB cube.

    Raises
    ------
    ValueError
        If the last axis is not 3 or the dtype is not float32 or float64.
    """
    image = _check_rgb(image)
    return (image - YCBCR_OFFSET.astype(image.dtype)) @ YCBCR_TO_RGB.T.astype(image.dtype)


def to_linear(coded: Any) -> Any:
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
    # Clamping keeps infinite slopes and NaN out of the power: reverse mode multiplies them by zero,
    # which gives NaN.
    curved = power((maximum(coded, 0.04045) + 0.055) * (1 / 1.055), 2.4)
    return select(coded <= 0.04045, coded * (1 / 12.92), curved)


def to_coded(linear: Any) -> Any:
    """Encode linear light as sRGB: ``12.92 x``, above 0.0031308 ``1.055 x^(1 / 2.4) - 0.055``.

    This is the inverse of `to_linear`. The constants of the standard leave a step of 3e-8 between
    both parts.

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


def to_picture(space: str, rendered: NDArray[Any]) -> NDArray[Any]:
    """Convert a rendering of a set to what people look at: light becomes sRGB.

    Parameters
    ----------
    space : str
        Space of the set.
    rendered : ndarray of float, shape (..., C)
        Rows of the result of `eigengs_dr.render`.

    Returns
    -------
    ndarray, same shape and dtype
        Negative light becomes 0; other values are not clamped.
    """
    if rendered_as(space) == "linear":
        return np.asarray(to_coded(np.maximum(rendered, 0)))
    return rendered


def from_sum(space: str, summed: Any) -> Any:
    """Convert the sums of Gaussians to what a rendering holds, where decoding colours cannot.

    Parameters
    ----------
    space : str
        Space of the set.
    summed : ndarray of float, shape (..., C), or Dr.Jit tensor, shape (H, W, C)

    Returns
    -------
    array, same shape and type
        Light for logarithms, normals of length 1 for normals; else `summed`. Dr.Jit tensors carry
        derivatives.
    """
    if space == "log":
        return from_log(summed)
    return renormalize(summed) if space == "normal" else summed


def rendered_as(space: str) -> str | None:
    """Return what renderings of a set of a space are: "srgb", "linear", or None for data."""
    if space in ("data", "normal"):
        return None
    return "srgb" if space in ("ycbcr", "rgb") else "linear"


def decode(space: str, channels: Sequence[Any]) -> list[Any]:
    """Convert YCbCr channels to RGB, and return the channels of other spaces unchanged.

    Parameters
    ----------
    space : str
        Colour space of the channels, one of `SPACES`.
    channels : sequence of NumPy or Dr.Jit arrays
        One array for each channel, all of one shape; exactly three for ``"ycbcr"``.

    Returns
    -------
    list of arrays
        R, G, B for ``"ycbcr"``, not clamped, in the precision of the arrays; otherwise `channels`.

    Raises
    ------
    ValueError
        If the space is unknown, or if it is ``"ycbcr"`` and there are not three channels.
    """
    if space not in SPACES:
        raise ValueError(f"colour space {space!r} is unknown; use one of {', '.join(SPACES)}")
    if space != "ycbcr":
        return list(channels)
    if len(channels) != 3:
        raise ValueError(f"space 'ycbcr' needs 3 channels, not {len(channels)}; use space 'data'")
    y, cb, cr = channels
    # Python floats: a NumPy float64 scalar would promote a Dr.Jit float32 array to float64.
    matrix = YCBCR_TO_RGB.tolist()
    black = (-YCBCR_TO_RGB @ YCBCR_OFFSET).tolist()
    return [a * y + b * cb + c * cr + d for (a, b, c), d in zip(matrix, black, strict=True)]


def _functions(array: Any) -> tuple[Any, Any, Any]:
    """Return select, maximum and power for a NumPy or a Dr.Jit array."""
    if not isinstance(array, np.ndarray | np.generic | float):
        import drjit as dr  # loads libLLVM

        return dr.select, dr.maximum, dr.power
    if isinstance(array, np.ndarray | np.generic) and array.dtype not in (np.float32, np.float64):
        raise ValueError(f"array is {array.dtype}; convert to float32 or float64 in [0, 1] first")
    return np.where, np.maximum, np.power


def _check_rgb(image: NDArray[Any]) -> NDArray[Any]:
    """Refuse an image without three float channels: bytes would be read as values in [0, 1]."""
    image = np.asarray(image)
    if image.shape[-1:] != (3,):
        raise ValueError(f"image has shape {image.shape}; expected (..., 3)")
    if image.dtype not in (np.float32, np.float64):
        raise ValueError(f"image is {image.dtype}; convert to float32 or float64 in [0, 1] first")
    return image

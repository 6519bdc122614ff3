"""Pixels in arrays: what they are, and the checks of an array that shall be an image.

A picture of a camera holds sRGB codes, a rendering holds linear light. The numbers do not tell:
light that is decoded as sRGB is too dark. Files of integers hold sRGB, files of floats hold light;
`eigengs_dr.load_image` marks light by the type of the array, and a ``mitsuba.Bitmap`` tells itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..backend.feedback import warn
from .color import to_coded
from .strips import by_strips, map_threads, strips

ENCODINGS = ("srgb", "linear")
"""Names of what pixels are."""

MIN_PIXEL, MAX_PIXEL = -0.5, 1.5
"""Range of accepted sRGB pixels: resampled images overshoot [0, 1], but pixels in 0..255 are an
error."""

MAX_LIGHT = 1e9
"""Largest absolute value of light and of data, with 1 for white; squares of errors stay far inside
single precision."""


class ImageError(ValueError):
    """An image cannot be used; one line names the image, the reason and what to do."""


class LinearImage(np.ndarray):
    """An array of linear light, which `eigengs_dr.fit` and `eigengs_dr.save_image` know as such.

    It is a `numpy.ndarray` in every other way. Parts, sums, clamped values and multiples of it are
    linear light too. All else, as powers, comparisons and integers, is a plain array, and so is
    what `numpy.asarray` makes of it: its pixels count as sRGB.

    Attributes
    ----------
    encoding : str
        "linear".

    Examples
    --------
    >>> light = np.full((2, 2, 3), 0.5).view(LinearImage)
    >>> type(2 * light[:1]).__name__, type(light ** (1 / 2.2)).__name__
    ('LinearImage', 'ndarray')
    """

    encoding = "linear"

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        """Compute with plain arrays, and mark the result if it is still linear light."""
        light = [isinstance(x, LinearImage) for x in inputs]
        plain = [np.asarray(x) if mark else x for x, mark in zip(inputs, light, strict=True)]
        if "out" in options:
            options["out"] = tuple(
                np.asarray(x) if isinstance(x, LinearImage) else x for x in options["out"]
            )
        found = getattr(ufunc, method)(*plain, **options)
        linear = (
            ufunc in _LINEAR
            or ufunc.__name__ == "clip"
            or (ufunc in (np.multiply, np.matmul) and method == "__call__" and sum(light) == 1)
            or (ufunc is np.true_divide and light == [True, False])
        )
        if linear and isinstance(found, np.ndarray) and found.dtype.kind == "f":
            return found.view(LinearImage)
        return found

    def astype(self, dtype: Any, *arguments: Any, **options: Any) -> Any:
        """Convert as NumPy does; integers are no light."""
        found = super().astype(dtype, *arguments, **options)
        return found if found.dtype.kind == "f" else np.asarray(found)


_LINEAR = (np.add, np.subtract, np.positive, np.maximum, np.minimum)
"""Functions whose results are light if an argument is."""


def is_bitmap(image: Any) -> bool:
    """Return whether an object is a ``mitsuba.Bitmap``; this module does not know Mitsuba."""
    return hasattr(image, "srgb_gamma") and hasattr(image, "component_format")


def is_tensor(image: Any) -> bool:
    """Return whether an object is an array of Dr.Jit."""
    return type(image).__module__.startswith("drjit.")


def check_encoding(encoding: str | None) -> None:
    """Raise ValueError if the name is unknown; None is no name, but the default."""
    if encoding is not None and encoding not in ENCODINGS:
        known = ", ".join(ENCODINGS)
        raise ValueError(f"encoding {encoding!r} is unknown; use one of {known}")


def encoding_of(image: Any, encoding: str | None = None) -> str | None:
    """Return what the pixels of an image are.

    Parameters
    ----------
    image : object
    encoding : {"srgb", "linear"}, optional
        What the caller says; it overrules the image.

    Returns
    -------
    {"srgb", "linear"} or None
        None if neither the caller nor the image says it.

    Warns
    -----
    UserWarning
        If the image is a Dr.Jit tensor of three channels and the caller does not say: renderings
        are light or sRGB.

    Raises
    ------
    ValueError
        If the name is unknown.
    """
    check_encoding(encoding)
    if encoding is not None:
        return encoding
    if isinstance(image, LinearImage):
        return "linear"
    if is_bitmap(image):
        return "srgb" if image.srgb_gamma() else "linear"
    if is_tensor(image) and tuple(getattr(image, "shape", ()))[2:] == (3,):
        warn(
            "a Dr.Jit tensor does not say what its pixels are; say encoding='linear' for light, as "
            "of mitsuba.render, or encoding='srgb'"
        )
    return None


def check_image(
    image: ArrayLike, keep_grey: bool = False, copy: bool = True, encoding: str | None = None
) -> NDArray[np.float32]:
    """Convert an array to sRGB in float32, and refuse an array that is not an image.

    Parameters
    ----------
    image : array_like, shape (H, W), (H, W, 1) or (H, W, 3)
        Grey or RGB: uint8 or uint16 (scaled to [0, 1]), bool, or floats with 1 as white. sRGB may
        overshoot [0, 1] by 0.5, as in resampled images; it is not clamped. Light may have any
        finite value. A ``mitsuba.Bitmap`` and a `LinearImage` say themselves what they are.
    keep_grey : bool, optional
        Return one channel if the image is grey.
    copy : bool, optional
        Without it, a C-contiguous image of float32 in sRGB is returned as it is.
    encoding : {"srgb", "linear"}, optional
        What the pixels are. By default what the image says, else "srgb".

    Returns
    -------
    ndarray of float32, shape (H, W, 3) or (H, W, 1)
        sRGB: light above 1 gives codes above 1, see `eigengs_dr.image.color.to_coded`. The array is
        C-contiguous. It shares no memory with `image`, unless `copy` is False.

    Raises
    ------
    ImageError
        If the shape, the dtype or the range is wrong, the image has no pixels, or a pixel is not
        finite.
    ValueError
        If the encoding is unknown.

    Examples
    --------
    >>> check_image(np.array([[0, 51], [102, 255]], np.uint8))[..., 0]
    array([[0. , 0.2],
           [0.4, 1. ]], dtype=float32)
    """
    if encoding_of(image, encoding) == "linear":
        light = check_light(to_floats(image, "image", keep_grey, copy=False), "image")
        return by_strips(to_coded, light)
    return check_range(to_floats(image, "image", keep_grey, copy), "image")


def mark_image(image: ArrayLike, encoding: str | None = None) -> NDArray[np.float32]:
    """Convert an array to float32 as `eigengs_dr.load_image` does a file: light stays light.

    For parameters and errors see `check_image`.

    Returns
    -------
    ndarray of float32, shape (H, W, 3)
        A `LinearImage` for light.
    """
    if encoding_of(image, encoding) == "linear":
        return check_light(to_floats(image, "image"), "image").view(LinearImage)
    return check_range(to_floats(image, "image"), "image")


def check_data(image: ArrayLike, copy: bool = True) -> NDArray[np.float32]:
    """Convert an array of data to float32: one channel or three, of any finite values.

    For parameters, result and errors see `check_image`; integers are scaled to [0, 1], and nothing
    is converted to sRGB.
    """
    return check_light(to_floats(image, "image", keep_grey=True, copy=copy), "image")


def to_floats(
    image: ArrayLike, name: str, keep_grey: bool = False, copy: bool = True
) -> NDArray[np.float32]:
    """Scale to float32 and replicate grey to RGB; errors call the image `name`."""
    try:
        array = np.asarray(image)
    except ValueError:  # rows of unequal length
        raise ImageError(f"{name}: not an array; expected shape (H, W, 3)") from None
    if array.ndim == 2:
        array = array[..., None]
    if array.ndim != 3 or array.shape[2] not in (1, 3):
        alpha = array.ndim == 3 and array.shape[2] == 4
        hint = "drop alpha, as in image[..., :3]" if alpha else "pass one grey or RGB image"
        raise ImageError(f"{name}: shape {array.shape}, expected (H, W) or (H, W, 3); {hint}")
    if array.size == 0:
        raise ImageError(f"{name}: shape {array.shape} has no pixels; check how it was cropped")

    kind = array.dtype.kind
    if kind not in "bf" and not (kind == "u" and array.itemsize <= 2):
        expected = "expected uint8, uint16 or floats in [0, 1]"
        raise ImageError(f"{name}: pixels are {array.dtype}; {expected}")
    # The extremes are finite only if all pixels are; they need no array of flags.
    if kind == "f" and not (np.isfinite(array.min()) and np.isfinite(array.max())):
        bad = np.argwhere(~np.isfinite(array).all(axis=2))
        row, column = bad[0].tolist()
        raise ImageError(
            f"{name}: {len(bad)} of {array.shape[0] * array.shape[1]} pixels are not finite, "
            f"the first at [{row}, {column}]; replace them, as with np.nan_to_num"
        )
    channels = array.shape[2] if keep_grey else 3
    as_it_is = array.dtype == np.float32 and array.shape[2] == channels
    if as_it_is and not copy and array.flags.c_contiguous:
        return array
    peak = np.iinfo(array.dtype).max if kind == "u" else 1
    pixels = np.empty((*array.shape[:2], channels), np.float32)

    def fill(rows: slice) -> None:
        with np.errstate(over="ignore"):  # callers clamp or refuse the infinities
            pixels[rows] = np.divide(array[rows], peak, dtype=np.float32)

    map_threads(fill, strips(*pixels.shape[:2]))
    return pixels


def check_light(pixels: NDArray[np.float32], name: str) -> NDArray[np.float32]:
    """Refuse light or data whose squares would leave single precision."""
    low, high = float(pixels.min()), float(pixels.max())
    if max(-low, high) > MAX_LIGHT:
        raise ImageError(f"{name}: pixels run from {low:g} to {high:g}; scale it first")
    return pixels


def check_range(pixels: NDArray[np.float32], name: str) -> NDArray[np.float32]:
    """Refuse pixels far outside [0, 1]."""
    low, high = float(pixels.min()), float(pixels.max())
    if low < MIN_PIXEL or high > MAX_PIXEL:
        hint = "divide by 255" if 2 < high <= 255 and low >= 0 else "scale it"
        light = ", or say encoding='linear' for light" if low >= 0 else ""
        raise ImageError(
            f"{name}: pixels run from {low:g} to {high:g}, not 0 to 1; {hint} first{light}"
        )
    return pixels

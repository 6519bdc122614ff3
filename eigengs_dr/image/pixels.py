"""Pixels in arrays: their encoding, the checks of an image, and strips of its rows.

A photo holds sRGB codes, a rendering holds linear light. The values do not show which: light that
is decoded as sRGB is too dark. Files of integers hold sRGB, files of floats hold light, and a
``mitsuba.Bitmap`` knows its encoding; for other arrays the caller passes ``encoding=``.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from operator import index
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..backend.entry_points import check_types
from ..backend.messages import printable, shown, warn
from ..backend.types import ArrayLike, PathLike, Singles, Tensor, Values
from ..storage.atomic import is_url
from ..storage.memory import ALWAYS, check_usable
from .color import to_coded
from .notes import Notes, transparency_note

Pixels = Values
"""Pixels (H, W, C) of any dtype."""

Item = TypeVar("Item")
Result = TypeVar("Result")

ENCODINGS = ("srgb", "linear")
"""Names of the encodings of pixels."""

MIN_PIXEL, MAX_PIXEL = -0.5, 1.5
"""Accepted range of sRGB pixels: resampled images overshoot [0, 1], but pixels in 0..255 are an
error."""

WHITE = 1.001
"""Largest sRGB code of light that counts as bounded by white; renderings exceed 1 by rounding."""

MAX_LIGHT = 1e9
"""Largest absolute value of light and of data, with 1 as white; squared errors stay well within the
range of single precision."""


C1, C2 = 0.01**2, 0.03**2
"""Constants of SSIM for images whose white is 1."""


class ImageError(ValueError):
    """An image cannot be used; one line names the image, the reason and what to do."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))  # names in a file may hold control characters


URL_NOTE = "is a URL; download it first, and give the file"
"""What a user is told who gives a URL where the path of an image is expected."""


def local_path(name: PathLike) -> Path:
    """Return the path of an image; raise OSError for a URL, which nothing here fetches."""
    if is_url(name):
        raise OSError(f"{name}: {URL_NOTE}")
    return Path(name)


def reason_of(error: BaseException) -> str:
    """Return the first line of an error, or its type."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


class EncodedImage(NamedTuple):
    """The pixels of an image, and what is known about them.

    Attributes
    ----------
    pixels : array_like, shape (H, W), (H, W, 1) or (H, W, 3)
    encoding : {"srgb", "linear"} or None
        None if it is unknown; such pixels count as sRGB.
    name : str
        What errors call the image: the path of a file.
    """

    pixels: Any
    encoding: str | None
    name: str = "image"


def check_encoding(encoding: str | None) -> None:
    """Raise ValueError if the encoding is unknown; None stands for the default."""
    check_types({"encoding": encoding}, {"encoding": "str | None"})
    if encoding is not None and encoding not in ENCODINGS:
        known = ", ".join(ENCODINGS)
        raise ValueError(f"encoding {encoding!r} is unknown; use one of {known}")


def encoding_of(image: object, encoding: str | None = None) -> str | None:
    """Return the encoding of the pixels of an image.

    Parameters
    ----------
    image : object
    encoding : {"srgb", "linear"}, optional
        Encoding given by the caller, which takes precedence.

    Returns
    -------
    {"srgb", "linear"} or None
        None if it is unknown.

    Warns
    -----
    UserWarning
        If the image is a Dr.Jit tensor of three channels and `encoding` is None: renderings are
        light or sRGB.

    Raises
    ------
    ValueError
        If the encoding is unknown.
    """
    check_encoding(encoding)
    if encoding is not None:
        return encoding
    if is_bitmap(image):
        return "srgb" if image.srgb_gamma() else "linear"  # type: ignore[attr-defined]
    if is_drjit(image) and tuple(getattr(image, "shape", ()))[2:] == (3,):
        warn(
            "the encoding of a Dr.Jit tensor is not known; pass encoding='linear' for light, e.g. "
            "from mitsuba.render, or encoding='srgb'; eigengs_dr.picture_of needs none"
        )
    return None


def is_drjit(value: object) -> bool:
    """Return whether a value is an array or a tensor of Dr.Jit, without importing it."""
    return type(value).__module__.startswith("drjit.")


def is_bitmap(image: object) -> bool:
    """Return whether an image is a ``mitsuba.Bitmap``, without importing Mitsuba."""
    return hasattr(image, "srgb_gamma") and hasattr(image, "component_format")


def peak_of(dtype: np.dtype) -> int:
    """Return the value of white: the largest integer of a type, or 1 for floats and bool.

    Raises
    ------
    ValueError
        If pixels have another type.
    """
    if dtype.kind in "bf":
        return 1
    if dtype.kind == "u" and dtype.itemsize <= 2:
        return int(np.iinfo(dtype).max)
    raise ValueError(f"pixels are {dtype}; expected uint8, uint16 or floats in [0, 1]")


def scale_to_white(pixels: Pixels, peak: int) -> NDArray[np.float32]:
    """Divide pixels by the value of white."""
    with np.errstate(over="ignore"):  # infinities are clamped or rejected later
        return np.divide(pixels, peak, dtype=np.float32)


def over_background(pixels: Pixels, alpha: str) -> tuple[Pixels, Notes]:
    """Return colours without alpha, and a warning if some pixels were transparent.

    Parameters
    ----------
    pixels : ndarray, shape (H, W, C)
    alpha : str
        See `eigengs_dr.image.read.Header`.
    """
    if alpha == "none":
        return pixels, ()
    peak = peak_of(pixels.dtype)
    if not (pixels[..., -1] < peak).any():
        return pixels[..., :-1], ()
    if alpha == "light":
        return pixels[..., :-1], transparency_note(alpha)

    def blend(rows: Pixels) -> NDArray[np.float32]:
        rows = scale_to_white(rows, peak)
        if alpha == "associated":
            return rows[..., :-1] + (1 - rows[..., -1:])
        return 1 - rows[..., -1:] * (1 - rows[..., :-1])

    return by_strips(blend, pixels, channels=pixels.shape[2] - 1), transparency_note(alpha)


def floats_of(image: EncodedImage, keep_grey: bool = False) -> EncodedImage:
    """Return an image in float32, see `to_floats`, after a check of its range."""
    pixels, encoding = to_floats(image, keep_grey), image.encoding or "srgb"
    _check_range(pixels, image.name, encoding)
    return EncodedImage(pixels, encoding, image.name)


def data_of(image: EncodedImage) -> NDArray[np.float32]:
    """Return data in float32: one to three channels, of any finite values."""
    pixels = to_floats(image, keep_grey=True, known=(1, 2, 3))
    _check_range(pixels, image.name, "linear")
    return pixels


def codes_of(image: EncodedImage) -> NDArray[np.float32]:
    """Return checked pixels as sRGB codes, above 1 for light above 1."""
    return by_strips(to_coded, image.pixels) if image.encoding == "linear" else image.pixels


def to_floats(
    image: EncodedImage, keep_grey: bool = False, known: tuple[int, ...] = (1, 3)
) -> NDArray[np.float32]:
    """Scale to float32 and replicate grey to RGB; pixels that need neither are not copied.

    Numbers of channels that are not `known` are refused.
    """
    name = image.name
    check_floats(image.pixels, name, 1 if keep_grey else 3)
    try:
        array = np.asarray(image.pixels)
    except ValueError:  # rows of unequal length
        raise ImageError(
            f"{name}: not an array; expected shape (H, W, 3); fit_many takes several images"
        ) from None
    if array.ndim == 2:
        array = array[..., None]
    if array.ndim != 3 or array.shape[2] not in known:
        hints = {2: "fit two channels as space='data'", 4: "drop alpha, as in image[..., :3]"}
        hint = hints.get(array.shape[-1] if array.ndim == 3 else 0, "pass one grey or RGB image")
        if array.ndim == 4 or array.dtype.kind in "UO":  # arrays or files
            hint = "fit_many takes several images"
        raise ImageError(f"{name}: shape {array.shape}, expected (H, W) or (H, W, 3); {hint}")
    if array.size == 0:
        raise ImageError(f"{name}: shape {array.shape} has no pixels; check how it was cropped")

    try:
        peak = peak_of(array.dtype)
    except ValueError as error:
        raise ImageError(f"{name}: {error}") from None
    # The extremes are finite only if all pixels are; this needs no array of flags.
    if array.dtype.kind == "f" and not (np.isfinite(array.min()) and np.isfinite(array.max())):
        bad = np.argwhere(~np.isfinite(array).all(axis=2))
        row, column = bad[0].tolist()
        raise ImageError(
            f"{name}: {len(bad)} of {array.shape[0] * array.shape[1]} pixels are not finite, "
            f"the first at [{row}, {column}]; replace them, e.g. with np.nan_to_num"
        )
    channels = array.shape[2] if keep_grey else 3
    pixels: NDArray[np.float32] = array
    usable = array.dtype == np.float32 and array.shape[2] == channels
    if not usable or not array.flags.c_contiguous:
        pixels = by_strips(partial(scale_to_white, peak=peak), array, channels=channels)
    return pixels


def check_floats(image: object, name: str, channels: int = 1) -> None:
    """Raise ImageError, by the shape alone, if pixels as floats take more memory than there is.

    An array may be a file, or the recipe of one, of which nothing is read yet.
    """
    shape: Any = getattr(image, "shape", ())
    needed = 4.0 * math.prod(shape[:2]) * max([channels, *shape[2:3]])
    if len(shape) > 1 and needed > ALWAYS:
        try:
            advice = "scale them down, or work on parts of them, as fit_large does"
            check_usable(needed, f"{name}: {shape[1]}x{shape[0]} pixels", advice)
        except ValueError as error:
            raise ImageError(str(error)) from None


def _check_range(pixels: NDArray[np.float32], name: str, encoding: str) -> None:
    """Reject sRGB far outside [0, 1], and light whose squares would overflow single precision."""
    low, high = float(pixels.min()), float(pixels.max())
    if encoding == "linear":
        if max(-low, high) > MAX_LIGHT:
            raise ImageError(f"{name}: pixels run from {low:g} to {high:g}; scale it first")
    elif low < MIN_PIXEL or high > MAX_PIXEL:
        hint = "divide by 255" if 2 < high <= 255 and low >= 0 else "scale it"
        light = ", or pass encoding='linear' for light" if low >= 0 else ""
        raise ImageError(
            f"{name}: pixels run from {low:g} to {high:g}, not 0 to 1; {hint} first{light}"
        )


def check_weight(weight: ArrayLike | None) -> Singles | None:
    """Return factors of the errors of pixels as float32, shape (H, W) or (H, W, C), with mean 1.

    Raises
    ------
    ValueError
        If a factor is no number, negative or not finite, or all are 0.
    """
    if weight is None:
        return None
    check_floats(weight, "weight")
    try:
        given = np.asarray(weight)
    except ValueError:  # rows of unequal length
        raise ValueError("weight: not an array; expected shape (H, W) or (H, W, C)") from None
    if given.dtype.kind not in "biuf" or np.ma.is_masked(weight):
        kind = "masked values" if np.ma.is_masked(weight) else given.dtype
        raise ValueError(f"weight holds {kind}; expected real numbers, (H, W) or (H, W, C)")
    factors = np.asarray(given, np.float32)
    if factors.ndim not in (2, 3) or not factors.size:
        raise ValueError(f"weight has shape {factors.shape}; expected (H, W) or (H, W, C)")
    if not np.isfinite(factors).all() or factors.min() < 0:
        raise ValueError("weight: factors of the errors must be finite and at least 0")
    if not factors.any():
        raise ValueError("weight is 0 for all pixels; at least one must count")
    return np.asarray(factors / factors.mean(dtype=np.float64), np.float32)


def check_size(size: Iterable[int]) -> tuple[int, int]:
    """Return a size, (width, height) in pixels, as two integers.

    Parameters
    ----------
    size : (int, int)

    Raises
    ------
    ValueError
        If `size` is not a pair of integers, or a side is not positive.
    """
    try:
        width, height = map(index, size)
    except (TypeError, ValueError):
        raise ValueError(
            f"size is {shown(size)}; expected (width, height) in whole pixels"
        ) from None
    if min(width, height) < 1:
        raise ValueError(f"size is {width}x{height}; both sides must be at least 1 pixel")
    return width, height


def is_tensor(value: object) -> TypeGuard[Tensor]:
    """Return whether a value is a Dr.Jit tensor of floats that may have derivatives."""
    kind = type(value)
    if not (kind.__module__.startswith("drjit.") and kind.__module__.endswith(".ad")):
        return False
    import drjit as dr

    return dr.is_tensor_v(kind) and dr.is_float_v(kind)


# ---------------------------------------------------------------------------------------------
#  Strips of rows
# ---------------------------------------------------------------------------------------------

# Temporary arrays are bounded, and several threads work. The borders of the strips depend only on
# the size of the image, so a result does not depend on the number of threads.

STRIP_PIXELS = 1 << 19
"""Number of pixels of a strip. One plane of it takes 2 MB in single precision: larger strips do not
fit into the cache; with smaller ones, threads wait for each other and borders of filters are
computed twice."""

MAX_THREADS = 8
"""Largest number of threads: in Python, only one of them starts an operation at a time."""


def strips(height: int, width: int) -> list[slice]:
    """Divide an image into strips of about `STRIP_PIXELS` pixels.

    Parameters
    ----------
    height, width : int
        Size of the image in pixels.

    Returns
    -------
    list of slice
        The rows of each strip, from top to bottom.
    """
    rows = max(1, STRIP_PIXELS // max(width, 1))
    return [slice(first, min(first + rows, height)) for first in range(0, height, rows)]


def map_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Call a function for every item on several threads, and return the results in order.

    Parameters
    ----------
    function : callable
        NumPy releases the interpreter lock, so operations on large arrays run in parallel.
    items : iterable
        A single item is processed in the calling thread.

    Returns
    -------
    list
        ``[function(item) for item in items]``; the first error is raised.
    """
    items = list(items)
    threads = min(MAX_THREADS, available_cores(), len(items))
    if threads < 2:
        return [function(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(function, items))


def by_strips(
    function: Callable[[Pixels], Pixels],
    image: Pixels,
    dtype: type[np.generic] = np.float32,
    channels: int | None = None,
) -> Pixels:
    """Apply a pixelwise function to an image without large temporary arrays.

    Parameters
    ----------
    function : callable
        ``function(rows)`` returns rows of the result, or one channel that is broadcast.
    image : ndarray, shape (H, W, C)
    dtype : dtype, optional
        Type of the result.
    channels : int, optional
        Number of channels of the result, by default that of the image.

    Returns
    -------
    ndarray of type `dtype`, shape (H, W, channels)
    """
    result = np.empty((*image.shape[:2], channels or image.shape[2]), dtype)

    def fill(rows: slice) -> None:
        result[rows] = function(image[rows])

    map_threads(fill, strips(*image.shape[:2]))
    return result


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1

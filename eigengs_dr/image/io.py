"""Image files and arrays: load, check, save."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..storage.atomic import atomic_write
from .strips import map_threads, strips

if TYPE_CHECKING:
    from PIL.Image import Image

SAVE_OPTIONS: dict[str, dict[str, Any]] = {
    ".png": {},
    ".jpg": {"quality": 95},
    ".jpeg": {"quality": 95},
    ".webp": {"quality": 95},
    ".tif": {},
    ".tiff": {},
    ".bmp": {},
    ".ppm": {},
}
"""Suffixes of image files, with the options that Pillow receives when it writes a file."""

MIN_PIXEL, MAX_PIXEL = -0.5, 1.5
"""Range of accepted float pixels: resampled images overshoot [0, 1], but pixels in 0..255 are an
error."""


class ImageError(ValueError):
    """An image cannot be used; one line names the image, the reason and what to do."""


def load_image(path: str | Path, keep_grey: bool = False) -> NDArray[np.float32]:
    """Read an image file as RGB.

    The function replicates grey, converts palette, CMYK and YCbCr, and applies the orientation of
    the EXIF header. It ignores colour profiles. An 8-bit value v becomes v/255 exactly. 16-bit grey
    keeps its precision (v/65535). Pillow keeps only the upper 8 bits of 16-bit RGB, 16-bit RGBA and
    16-bit grey with alpha.

    Parameters
    ----------
    path : str or Path
        A file in any format that Pillow reads.
    keep_grey : bool, optional
        Return one channel if the file is opaque grey.

    Returns
    -------
    ndarray of float32, shape (H, W, 3) or (H, W, 1)
        RGB in [0, 1]; values of float files are not scaled.

    Warns
    -----
    UserWarning
        If the image has transparent pixels, which are shown over white. If the file holds several
        frames, of which the first is used.

    Raises
    ------
    ImageError
        If the file is missing, empty, damaged, too large or not an image.
    """
    path = Path(path)
    with open_picture(path) as file:
        frames = getattr(file, "n_frames", 1)
        pixels, transparent = picture_pixels(file)
    if transparent:
        warnings.warn(f"{path}: transparent pixels are shown over white", stacklevel=2)
    if frames > 1:
        warnings.warn(f"{path}: holds {frames} frames, the first is used", stacklevel=2)
    return _check_range(_rgb(pixels, str(path), keep_grey), str(path))


@contextmanager
def open_picture(path: Path) -> "Iterator[Image]":
    """Open an image file with Pillow, turned as its EXIF header says; errors as `load_image`."""
    from PIL import Image, ImageOps, UnidentifiedImageError  # 0.05 s

    try:
        if path.stat().st_size == 0:
            raise ImageError(f"{path}: the file is empty (0 bytes); copy or export it again")
        with Image.open(path) as file:
            ImageOps.exif_transpose(file, in_place=True)  # a copy only if it turns the image
            yield file
    except ImageError:
        raise
    except FileNotFoundError:
        raise ImageError(f"{path}: no such file; check the path") from None
    except IsADirectoryError:
        raise ImageError(f"{path}: is a folder; name an image file in it") from None
    except PermissionError:
        raise ImageError(f"{path}: may not be read; check its permissions") from None
    except UnidentifiedImageError:
        raise ImageError(
            f"{path}: not an image that Pillow knows; save it as PNG or JPEG"
        ) from None
    except Image.DecompressionBombError:
        limit = f"{2 * (Image.MAX_IMAGE_PIXELS or 0):,}"
        raise ImageError(
            f"{path}: has more than {limit} pixels; scale it down first, or fit it in blocks"
        ) from None
    except Exception as error:  # on damaged files Pillow's decoders raise many types
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ImageError(f"{path}: damaged or unsupported ({reason}); export it again") from error


def check_image(
    image: ArrayLike, keep_grey: bool = False, copy: bool = True
) -> NDArray[np.float32]:
    """Convert an array to a float32 image, and refuse an array that is not an image.

    Parameters
    ----------
    image : array_like, shape (H, W), (H, W, 1) or (H, W, 3)
        Grey or RGB: uint8 or uint16 (scaled to [0, 1]), bool, or floats with 1 as white. Floats may
        overshoot [0, 1] by 0.5, as in resampled images; they are not clamped.
    keep_grey : bool, optional
        Return one channel if the image is grey.
    copy : bool, optional
        Without it, a C-contiguous image of float32 is returned as it is.

    Returns
    -------
    ndarray of float32, shape (H, W, 3) or (H, W, 1)
        RGB. The array is C-contiguous. It shares no memory with `image`, unless `copy` is False.

    Raises
    ------
    ImageError
        If the shape, the dtype or the range is wrong, the image has no pixels, or a pixel is not
        finite.

    Examples
    --------
    >>> check_image(np.array([[0, 51], [102, 255]], np.uint8))[..., 0]
    array([[0. , 0.2],
           [0.4, 1. ]], dtype=float32)
    """
    return _check_range(_rgb(image, "image", keep_grey, copy), "image")


def save_image(path: str | Path, image: ArrayLike) -> None:
    """Write an image file with 8 bits per channel, completely or not at all.

    Parameters
    ----------
    path : str or Path
        The suffix selects the format: .png, .tif, .tiff, .bmp and .ppm are lossless; .jpg, .jpeg
        and .webp have quality 95. An existing file is replaced.
    image : array_like, shape (H, W), (H, W, 1) or (H, W, 3)
        RGB, or grey, which is written with one channel. Types as for `check_image`; finite floats
        of any value are clamped to [0, 1].

    Raises
    ------
    ImageError
        If the array is not an image, the suffix is unknown or the file cannot be written. An
        existing file does not change.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SAVE_OPTIONS:
        known = " ".join(SAVE_OPTIONS)
        raise ImageError(f"{path}: image suffix {suffix!r} is unknown; use one of {known}")
    ready = isinstance(image, np.ndarray) and image.dtype == np.uint8 and image.size
    if ready and image.shape[2:] in ((1,), (3,)):  # type: ignore[union-attr]
        return _write(path, np.asarray(image))  # large pictures need no copy
    floats = _rgb(image, "image", keep_grey=True, copy=False)
    height, width = floats.shape[:2]
    pixels = np.empty(floats.shape, np.uint8)

    def fill(rows: slice) -> None:
        pixels[rows] = to_8bit(floats[rows])

    map_threads(fill, strips(height, width))
    _write(path, pixels)


def _write(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write pixels (H, W, C) as the suffix of the path says."""
    from PIL import Image

    pixels = pixels[..., 0] if pixels.shape[2] == 1 else pixels
    try:
        with atomic_write(path) as temporary:
            Image.fromarray(pixels).save(temporary, **SAVE_OPTIONS[path.suffix.lower()])
    except (OSError, ValueError) as error:
        message = str(error)
        if not message.startswith(f"{path}: "):  # errors of atomic_write are clear already
            reason = getattr(error, "strerror", None) or message
            message = f"{path}: cannot be written ({reason}); choose another path"
        raise ImageError(message) from error


def to_8bit(image: NDArray[Any], out: NDArray[Any] | None = None) -> NDArray[Any]:
    """Scale, clamp and round an image to 8 bits, and return the values as floats.

    Parameters
    ----------
    image : ndarray of float
        0 is black, 1 is white.
    out : ndarray of float, optional
        Receives the result; may be `image`.

    Returns
    -------
    ndarray, same shape and dtype
        Whole numbers from 0 to 255; NaN stays NaN.
    """
    clipped = np.clip(image, 0, 1, out=out)
    clipped *= 255
    return np.rint(clipped, out=clipped)


def picture_pixels(image: "Image") -> tuple[NDArray[Any], bool]:
    """Return the pixels of a Pillow image, and whether some of them are transparent."""
    if image.mode == "I":  # 16-bit grey of PGM files comes as 32-bit integers
        return np.asarray(image) / 65535, False
    if image.mode == "F" or image.mode.startswith("I;16"):
        return np.asarray(image), False
    if not image.has_transparency_data:
        # `convert` copies the image even if the mode stays.
        return np.asarray(image if image.mode in ("1", "L", "RGB") else image.convert("RGB")), False
    pixels = np.asarray(image.convert("RGBA"))
    shown = np.empty((*pixels.shape[:2], 3), np.float32)

    def show_over_white(rows: slice) -> None:
        part = pixels[rows].astype(np.float32) / 255
        color, alpha = part[..., :3], part[..., 3:]
        shown[rows] = 1 - alpha * (1 - color)

    map_threads(show_over_white, strips(*shown.shape[:2]))
    return shown, bool(pixels[..., 3].min() < 255)


def _rgb(
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


def _check_range(pixels: NDArray[np.float32], name: str) -> NDArray[np.float32]:
    """Refuse pixels far outside [0, 1]."""
    low, high = float(pixels.min()), float(pixels.max())
    if low < MIN_PIXEL or high > MAX_PIXEL:
        hint = "divide by 255" if 2 < high <= 255 and low >= 0 else "scale it"
        raise ImageError(f"{name}: pixels run from {low:g} to {high:g}, not 0 to 1; {hint} first")
    return pixels

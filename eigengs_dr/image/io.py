"""Loading and saving of image files; photos of scikit-image."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..backend.entry_points import checks_types
from ..backend.messages import printable
from ..backend.types import ArrayLike, PathLike
from ..storage.atomic import atomic_write, refuse_url
from ..storage.memory import SETTING, stream_limit
from .color import to_coded, to_linear
from .formats import BITS, SUFFIXES, write_file
from .notes import ABOVE_WHITE, Notes, kept_notes, tell
from .pixels import (
    MAX_PIXEL,
    WHITE,
    EncodedImage,
    ImageError,
    Pixels,
    by_strips,
    check_encoding,
    check_floats,
    codes_of,
    data_of,
    encoding_of,
    floats_of,
    is_bitmap,
    is_drjit,
    local_path,
    over_background,
    peak_of,
    reason_of,
    to_floats,
)
from .read import decode, is_picture, picture_pixels, read_header
from .space import Space


@checks_types
def load_image(
    path: PathLike, keep_grey: bool = False, upright: bool = True
) -> NDArray[np.float32]:
    """Read an image file as RGB.

    The function replicates grey, converts palette, CMYK and YCbCr, and applies the orientation. It
    ignores colour profiles, with a warning if one is not sRGB. Integers are divided by their
    largest value, so that 1 is white. Floats are not converted. The manual has a table of the kinds
    of files.

    Parameters
    ----------
    path : str or Path
        TIFF, EXR, Radiance HDR, PNG, JPEG, PGM, PPM, PFM, and files that Pillow reads. A pipe
        or a socket of up to 1 GB is accepted too.
    keep_grey : bool, optional
        Return one channel if the file is grey and opaque.
    upright : bool, optional
        If false, an EXIF orientation is ignored: the pixels are those that the file stores, as in
        photos for `Relightable.fit`.

    Returns
    -------
    ndarray of float32, shape (H, W, 3) or (H, W, 1)
        sRGB in [0, 1], or linear light without bounds if the file holds floats. Pass an array of
        light on with ``encoding="linear"``; functions that take the file itself, such as `fit`,
        know its encoding.

    Warns
    -----
    UserWarning
        If the image has transparent pixels, which are shown over white, or over black in an EXR
        file. If the file holds several images, of which the first is used; channels that are not
        colours; colours that are not sRGB; or more bits than are read.

    Raises
    ------
    ImageError
        If the file is missing, empty, damaged, not an image, or of an unsupported kind; its pixels
        would take implausibly much memory for its size; a pixel is not finite; or an EXR file holds
        one channel without `keep_grey`, or several layers.
    OSError
        If a pipe cannot be read, or the name is a URL, which nothing here fetches.
    """
    return read_floats(path, keep_grey, upright=upright).pixels


def read_image(
    image: object, keep_grey: bool = False, encoding: str | None = None, upright: bool = True
) -> EncodedImage:
    """Read an image of any kind: a file, a picture of Pillow, or an array, which stays as it is.

    Pixels are grey or RGB without alpha, in their own type. For files see `load_image`; `encoding`
    overrides that of the image, see `eigengs_dr.image.pixels.encoding_of`. Masked values are
    refused, because NumPy would take what is below the mask.
    """
    if isinstance(image, EncodedImage):
        return image._replace(encoding=encoding or image.encoding)
    pixels: Any = image
    name, alpha, notes = "image", "none", Notes()
    if isinstance(image, (str, os.PathLike)):
        with _local_file(image) as file:
            header = read_header(file, upright)
            header.check_memory(file)
            pixels, alpha = decode(file, header, keep_grey)
        name, notes, encoding = str(image), header.notes, encoding or header.encoding
    elif is_picture(image):
        try:
            pixels, alpha = picture_pixels(image)
        except ImageError as error:
            raise ImageError(f"image: {error}") from None
    elif np.ma.is_masked(image):
        raise ImageError(
            f"image: {np.ma.count_masked(image)} values are masked; fill them, as in "
            "image.filled(0), and give pixels that do not count the weight 0"
        )
    pixels, shown = over_background(pixels, alpha)
    for note in (*notes, *shown):
        tell(name, note)
    return EncodedImage(pixels, encoding_of(image, encoding), name)


def is_pipe(name: object) -> bool:
    """Return whether a source can be read only once: a pipe or a socket."""
    path = Path(str(name))
    return path.is_fifo() or path.is_socket()


@contextmanager
def _local_file(name: PathLike) -> Iterator[Path]:
    """Yield the path of a file; for a pipe, that of a temporary copy.

    Raises
    ------
    ImageError
        If a pipe has more bytes than `stream_limit`. Errors of the block name the pipe.
    OSError
        If it cannot be read; the message has the name.
    """
    if not is_pipe(name):
        yield local_path(name)
        return
    limit = stream_limit()
    with TemporaryDirectory() as folder:
        file = Path(folder) / "image"
        try:
            with open(name, "rb") as pipe, file.open("wb") as copy:
                while part := pipe.read(1 << 20):
                    if copy.tell() + len(part) > limit:
                        raise ImageError(
                            f"{name}: has more than {limit / 1e6:,.0f} MB; if you trust it, set "
                            f"{SETTING} to as many MB as it has"
                        )
                    copy.write(part)
        except OSError as error:
            raise OSError(f"{name}: cannot be read ({reason_of(error)})") from error
        try:
            yield file
        except ImageError as error:
            raise ImageError(str(error).replace(printable(str(file)), str(name))) from None


def read_floats(
    image: object, keep_grey: bool = False, encoding: str | None = None, upright: bool = True
) -> EncodedImage:
    """Read an image and convert it to float32 as `load_image` does, without changing its encoding.

    For parameters and errors see `check_image`.
    """
    return floats_of(read_image(image, keep_grey, encoding, upright), keep_grey)


def check_image(
    image: object, keep_grey: bool = False, encoding: str | None = None
) -> NDArray[np.float32]:
    """Convert an image to sRGB in float32, and reject what is not an image.

    Parameters
    ----------
    image : array_like, shape (H, W), (H, W, 1) or (H, W, 3); or path-like; or PIL image
        Grey or RGB: uint8 or uint16 (scaled to [0, 1]), bool, or floats with 1 as white. sRGB may
        overshoot [0, 1] by 0.5, as in resampled images; it is not clamped. Light may have any
        finite value. The encoding of a file or a ``mitsuba.Bitmap`` is known.
    keep_grey : bool, optional
        Return one channel if the image is grey.
    encoding : {"srgb", "linear"}, optional
        The encoding of the pixels. By default that of the image if it is known, else "srgb".

    Returns
    -------
    ndarray of float32, shape (H, W, 3) or (H, W, 1)
        sRGB: light above 1 gives codes above 1, see `eigengs_dr.image.color.to_coded`. The array is
        C-contiguous, and may be the image itself.

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
    return codes_of(read_floats(image, keep_grey, encoding))


def read_photo(
    photo: object, encoding: str | None = None, arrays: str = "linear", upright: bool = True
) -> EncodedImage:
    """Read a photo that may be a rendering, as float32; its encoding is not changed.

    Floats in a tensor of Dr.Jit are linear light, as those of `mitsuba.render`; floats in a list
    or another array are what `arrays` says; whole numbers are sRGB codes; other photos are what
    they say. For parameters and errors see `check_image`.
    """
    check_encoding(encoding)
    declared = (str, os.PathLike, EncodedImage)
    if not (isinstance(photo, declared) or is_picture(photo) or is_bitmap(photo)):
        is_rendering = is_drjit(photo)
        photo = _array_of(photo)
        if encoding is None and isinstance(photo, np.ndarray) and photo.dtype.kind == "f":
            encoding = "linear" if is_rendering else arrays
            if encoding == "linear":
                _refuse_bytes(photo)
    return read_floats(photo, encoding=encoding, upright=upright)


class Codes(NamedTuple):
    """sRGB codes of an image of a family that was checked, (H, W, 3); above 1 is light above 1."""

    pixels: NDArray[np.float32]


def check_member(
    image: object, encoding: str | None = None, name: str = "image"
) -> NDArray[np.float32]:
    """Return an image of a family in sRGB, which may be the array itself.

    A rendering is read as `read_photo` does; floats in other arrays are sRGB. Light above white
    keeps its codes, with a warning: the spaces of families end at white.
    """
    if isinstance(image, Codes):
        return image.pixels
    encoded = read_photo(image, encoding, arrays="srgb")
    pixels = codes_of(encoded)
    if encoded.encoding == "linear" and pixels.max() > WHITE:
        tell(encoded.name if encoded.name != "image" else name, ABOVE_WHITE)
    return pixels


def _array_of(photo: object) -> Any:
    """Return numbers as an array of NumPy; rows of unequal length unchanged, for their error."""
    check_floats(photo, "image")
    try:
        return np.asanyarray(photo)
    except ValueError:
        return photo


def _refuse_bytes(photo: NDArray[np.floating]) -> None:
    """Refuse floats that are whole numbers up to 255, which would be light far above white."""
    if not photo.size or not 2 < photo.max() <= 255 or photo.min() == photo.max():
        return
    if (photo == np.rint(photo)).all():
        raise ImageError(
            f"image: floats are whole numbers up to {photo.max():g}; divide by 255 and pass "
            "encoding='srgb', or pass encoding='linear' for light"
        )


def check_data(image: object) -> NDArray[np.float32]:
    """Convert an image of data to float32: one to three channels, of any finite values.

    For parameters, result and errors see `check_image`; integers are scaled to [0, 1], and values
    are not converted to sRGB.
    """
    return data_of(read_image(image, keep_grey=True, encoding="linear"))


def displayed(image: ArrayLike, space: Space, encoding: str | None = None) -> NDArray[np.float32]:
    """Return an image as display values, for sets of a space: sRGB, or data."""
    if space.is_color:
        return check_image(image, encoding=encoding)
    return check_data(image)


@checks_types
def save_image(
    path: PathLike, image: ArrayLike, encoding: str | None = None, bits: int | None = None
) -> None:
    """Write an image file atomically.

    Parameters
    ----------
    path : str or Path
        The suffix selects the format. Integers in sRGB: .png, .tif, .tiff, .bmp and .ppm are
        lossless; .jpg, .jpeg and .webp have quality 95. Floats in linear light: .exr, .hdr and
        .pfm. An existing file is replaced.
    image : array_like, shape (H, W), (H, W, 1) or (H, W, 3)
        RGB, or grey, which is written with one channel. Types as for `check_image`. Integers are
        clamped to [0, 1]; floats are not.
    encoding : {"srgb", "linear"}, optional
        The encoding of the pixels. They are converted to that of the file: light to sRGB in a .png
        file, sRGB to light in an .exr file. By default that of the image, see `check_image`; an
        array of unknown encoding is written without conversion.
    bits : {8, 16, 32}, optional
        Bits per value: 8 or 16 in .png; 8, 16 or 32 (floats) in .tif; 16 or 32, both floats, in
        .exr. By default 32 in .exr, .hdr and .pfm, else 8.

    Warns
    -----
    UserWarning
        If the image is a Dr.Jit tensor and `encoding` is not given.

    Raises
    ------
    ImageError
        If the array is not an image, the suffix is unknown, the format does not support the bits or
        the file cannot be written. An existing file does not change.
    """
    refuse_url(path)
    path = Path(path)
    bits = bits_of(path, bits)
    pixels, encoding, _ = read = read_image(image, keep_grey=True, encoding=encoding)
    if bits == 8 and encoding != "linear" and getattr(pixels, "dtype", None) == np.uint8:
        array = np.asarray(pixels)
        if array.size and array.shape[2:] in ((1,), (3,)):
            return write_pixels(path, array, bits)  # large pictures need no copy
    floats = to_floats(read, keep_grey=True)
    kind = dtype_of(path, bits)
    if encoding != "linear" and kind != np.float32 and MAX_PIXEL < floats.mean() <= 255:
        raise ImageError(
            f"{path}: pixels run from {floats.min():g} to {floats.max():g}, and 1 is white; "
            "divide by 255, or pass encoding='linear' for light"
        )
    write_pixels(path, by_strips(lambda part: to_file(part, encoding, kind), floats, kind), bits)


def bits_of(path: Path, bits: int | None = None) -> int:
    """Return the bits per value of a file to be written, by default those of its suffix.

    Raises
    ------
    ImageError
        If the suffix is unknown, or the format does not support the bits.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        known = " ".join(SUFFIXES)
        raise ImageError(f"{path}: image suffix {suffix!r} is unknown; use one of {known}")
    known_bits = BITS[suffix]
    if bits is not None and bits not in known_bits:
        supported = " or ".join(map(str, sorted(known_bits)))
        raise ImageError(f"{path}: bits is {bits}; a {suffix} file has {supported}")
    return bits or known_bits[0]


def dtype_of(path: Path, bits: int) -> type[np.generic]:
    """Return the type of the values of a file: uint8, uint16, or float32 for linear light."""
    floats = 8 not in BITS[path.suffix.lower()] or bits == 32
    return np.float32 if floats else np.uint8 if bits == 8 else np.uint16


def to_file(pixels: NDArray[np.floating], encoding: str | None, kind: type[np.generic]) -> Pixels:
    """Convert float pixels to the values of a file.

    Parameters
    ----------
    pixels : ndarray of float
    encoding : {"srgb", "linear"} or None
        Encoding of the pixels; with None they are not converted.
    kind : dtype
        uint8 and uint16 hold sRGB, clamped and rounded; float32 holds linear light.

    Returns
    -------
    ndarray, same shape, of the dtype `kind`
    """
    if kind == np.float32:
        light = to_linear(pixels) if encoding == "srgb" else pixels
        return np.asarray(light, np.float32)
    coded = to_coded(np.maximum(pixels, 0)) if encoding == "linear" else pixels
    return np.rint(np.clip(coded, 0, 1) * peak_of(np.dtype(kind))).astype(kind)


def write_pixels(path: Path, pixels: Pixels, bits: int) -> None:
    """Write pixels (H, W, C) of the type from `dtype_of` atomically.

    Raises
    ------
    ImageError
        If the file cannot be written.
    """
    try:
        with atomic_write(path) as temporary:
            write_file(temporary, pixels, bits)
    except (OSError, ValueError) as error:
        message = reason_of(error)
        if not message.startswith(f"{path}: "):  # errors of atomic_write are clear already
            reason = getattr(error, "strerror", None) or message
            message = f"{path}: cannot be written ({reason}); choose another path"
        raise ImageError(message) from error


def to_8bit(image: Pixels, out: Pixels | None = None) -> Pixels:
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
        Integer values from 0 to 255; NaN stays NaN.
    """
    clipped = np.clip(image, 0, 1, out=out)
    clipped *= 255
    return np.rint(clipped, out=clipped)


SAMPLES = {
    "astronaut": "astronaut.png",
    "brick": "brick.png",
    "camera": "camera.png",
    "chelsea": "chelsea.png",
    "coffee": "coffee.png",
    "coins": "coins.png",
    "grass": "grass.png",
    "gravel": "gravel.png",
    "hubble": "hubble_deep_field.jpg",
    "moon": "moon.png",
    "motorcycle": "motorcycle_left.png",
    "retina": "retina.jpg",
    "rocket": "rocket.jpg",
}
"""Files in the scikit-image wheel, by name; its other photos need a download."""


@checks_types
def sample(name: str) -> NDArray[np.float32]:
    """Load a photo that ships with scikit-image, without a download.

    Parameters
    ----------
    name : str
        One of `SAMPLES`, for example ``"astronaut"``, ``"chelsea"`` (a cat) or ``"coffee"``.

    Returns
    -------
    ndarray of float32, shape (H, W, 3)
        RGB in [0, 1]; grey photos have three equal channels.

    Raises
    ------
    ImageError
        If the name is unknown.
    """
    if name not in SAMPLES:
        raise ImageError(f"sample {name!r} is unknown; use one of {', '.join(SAMPLES)}")
    # find_spec locates the folder without the slow import of scikit-image.
    [folder] = find_spec("skimage").submodule_search_locations  # type: ignore[union-attr, misc]
    path = Path(folder) / "data" / SAMPLES[name]
    with kept_notes():  # one photo has another colour profile
        return load_image(path)

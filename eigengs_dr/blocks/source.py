"""Large images, read by windows: TIFF and ``.npy`` files, arrays, and what Pillow decodes."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..image.formats.registry import kind_of
from ..image.io import ImageError, load_image, open_picture, picture_pixels
from ..image.pixels import LinearImage, check_data, check_image, encoding_of
from ..image.remote import is_url
from .tiff import TIFF_SUFFIXES, holds_floats, read_window, window_shape

MAX_SIDE = 1 << 16
"""Longest side of a set of Gaussians, in pixels."""

GREY = ("1", "L", "I", "I;16", "I;16B", "I;16L", "F")
"""Modes of Pillow for opaque images of one channel."""

Array = NDArray[Any]
Read = Callable[[slice, slice], Array]


class Window(NamedTuple):
    """A part of an image that is read when it is needed, perhaps in another process.

    Attributes
    ----------
    load : callable
        Returns the pixels in the dtype of the source. It holds a path, or the pixels.
    keep_grey : bool
        Whether the image is data, which keep one channel.
    name : str
        The image and the part, for errors.
    encoding : {"srgb", "linear"}
        What the pixels are.
    unit : float
        Data are divided by it.
    """

    load: Callable[[], Array]
    keep_grey: bool
    name: str
    encoding: str = "srgb"
    unit: float = 1.0

    def read(self) -> NDArray[np.float32]:
        """Return the pixels: float32 of shape (h, w, 3), in sRGB, or data, perhaps (h, w, 1).

        Raises
        ------
        ImageError
            If the file cannot be read, a pixel is not finite, or one of an image is far outside
            [0, 1].
        """
        pixels = self.load()
        try:
            if self.keep_grey:
                data = check_data(pixels, copy=False)
                return data if self.unit == 1 else data / np.float32(self.unit)
            return check_image(pixels, copy=False, encoding=self.encoding)
        except ImageError as error:
            raise ImageError(f"{self.name}: {str(error).removeprefix('image: ')}") from None


@dataclass(frozen=True)
class Source:
    """A large image.

    Attributes
    ----------
    width, height : int
        Pixels.
    channels : int
        Channels of a fit: 1 or 3.
    name : str
        The path of the file, or "image".
    identity : dict
        What tells this image from others, in numbers and texts.
    cut : callable
        ``cut(rows, columns)`` returns what `Window.load` holds.
    keep_grey, encoding, unit
        See `Window`.
    """

    width: int
    height: int
    channels: int
    name: str
    identity: dict[str, Any]
    cut: Callable[[slice, slice], Callable[[], Array]]
    keep_grey: bool
    encoding: str = "srgb"
    unit: float = 1.0

    def window(self, rows: slice, columns: slice) -> Window:
        """Return a part of the image."""
        part = f"rows {rows.start} to {rows.stop}, columns {columns.start} to {columns.stop}"
        name = f"{self.name}, {part}"
        load = self.cut(rows, columns)
        return Window(load, self.keep_grey, name, self.encoding, self.unit)


def open_source(source: Any, keep_grey: bool = False, encoding: str | None = None) -> Source:
    """Open a large image without reading its pixels.

    Parameters
    ----------
    source : path-like or array
        A file: TIFF of grey or RGB by strips or tiles, and ``.npy``, are read by windows. Pillow
        decodes other files (PNG, JPEG, TIFF of other kinds) whole, into 4 bytes a pixel; files of
        floats or 16 bits take 12.
        Or an array (H, W, 3), (H, W, 1) or (H, W) of a type that `eigengs_dr.load_image` knows, of
        which ``source[top:bottom, left:right]`` is a part: NumPy's, also memory-mapped, zarr's,
        Dask's.
    keep_grey : bool, optional
        Whether the image is data: a grey one has one channel instead of three.
    encoding : {"srgb", "linear"}, optional
        What the pixels are. By default what the image says: "linear" for files of floats.

    Returns
    -------
    Source

    Raises
    ------
    ImageError
        If there is no such file, it is no image, or the shape or the size is wrong.
    """
    if is_url(source):
        source = load_image(source, keep_grey, encoding)
    if isinstance(source, (str, os.PathLike)):
        return _open_file(Path(source), keep_grey, encoding)
    if not hasattr(source, "shape") or not hasattr(source, "dtype"):
        kind = type(source).__name__
        raise ImageError(f"image: is a {kind}; pass a file or an array of shape (H, W, 3)")
    shape, dtype = tuple(int(side) for side in source.shape), np.dtype(source.dtype)
    identity = {"shape": list(shape), "dtype": dtype.str}

    def cut(rows: slice, columns: slice) -> Callable[[], Array]:
        return partial(np.asarray, np.asarray(source[rows, columns]))

    said = encoding_of(source, encoding) or "srgb"
    return _checked("image", shape, identity, cut, keep_grey, said)


def _open_file(path: Path, keep_grey: bool, encoding: str | None) -> Source:
    absolute = os.path.abspath(path)
    shape: tuple[int, ...] | None = None
    read: Read
    try:
        state = path.stat()
    except OSError as error:
        raise ImageError(f"{path}: {error.strerror or error}; check the path") from None
    if path.is_dir():
        raise ImageError(f"{path}: is a folder; name an image file in it")
    if path.suffix.lower() in TIFF_SUFFIXES:
        shape = window_shape(absolute)
    default = "srgb"
    if shape is not None:
        read = partial(read_window, absolute)
        default = "linear" if holds_floats(absolute) else "srgb"
    elif kind_of(path) is not None:
        picture = _loaded(absolute, state.st_mtime_ns, keep_grey)
        shape = picture.shape
        read = partial(_read_loaded, absolute, state.st_mtime_ns, keep_grey)
        default = "linear" if isinstance(picture, LinearImage) else "srgb"
    elif path.suffix.lower() == ".npy":
        shape = _array_shape(absolute)
        read = partial(_read_array, absolute)
    else:
        picture = _decoded(absolute, state.st_mtime_ns)
        shape = (picture.height, picture.width, 1 if picture.mode in GREY else 3)
        read = partial(_read_picture, absolute, state.st_mtime_ns)
    identity = {"file": absolute, "bytes": state.st_size, "modified": state.st_mtime_ns}

    def cut(rows: slice, columns: slice) -> Callable[[], Array]:
        return partial(read, rows, columns)

    return _checked(str(path), shape, identity, cut, keep_grey, encoding or default)


def _checked(
    name: str,
    shape: tuple[int, ...],
    identity: dict[str, Any],
    cut: Callable[[slice, slice], Callable[[], Array]],
    keep_grey: bool,
    encoding: str,
) -> Source:
    """Return a source, or refuse what is no image or too large."""
    if len(shape) not in (2, 3) or (len(shape) == 3 and shape[2] not in (1, 3)):
        raise ImageError(f"{name}: shape {shape}, expected (H, W) or (H, W, 3)")
    if not all(1 <= side <= MAX_SIDE for side in shape[:2]):
        raise ImageError(f"{name}: {shape[1]}x{shape[0]} pixels; sides go from 1 to {MAX_SIDE:,}")
    grey = len(shape) == 2 or shape[2] == 1
    channels = 1 if grey and keep_grey else 3
    return Source(shape[1], shape[0], channels, name, identity, cut, keep_grey, encoding)


def _array_shape(path: str) -> tuple[int, ...]:
    try:
        return tuple(np.load(path, mmap_mode="r", allow_pickle=False).shape)
    except (ValueError, EOFError, OSError) as error:
        raise ImageError(f"{path}: not a readable .npy file ({error})") from None


def _read_array(path: str, rows: slice, columns: slice) -> Array:
    """Read a part of a ``.npy`` file; the map of the file ends with the call."""
    return np.array(np.load(path, mmap_mode="r", allow_pickle=False)[rows, columns])


def _read_picture(path: str, modified: int, rows: slice, columns: slice) -> Array:
    """Return a part of a file that Pillow decodes."""
    box = (columns.start, rows.start, columns.stop, rows.stop)
    picture = _decoded(path, modified)
    # A crop would check the limit on pixels of the whole process.
    part = picture.resize((box[2] - box[0], box[3] - box[1]), resample=0, box=box)
    return picture_pixels(part)[0]


def _read_loaded(path: str, modified: int, keep_grey: bool, rows: slice, columns: slice) -> Array:
    """Return a part of a file of floats or 16 bits."""
    return np.asarray(_loaded(path, modified, keep_grey)[rows, columns])


@lru_cache(maxsize=1)
def _loaded(path: str, modified: int, keep_grey: bool) -> Array:
    """Read a file of floats or 16 bits whole, and keep it; see `_decoded`."""
    return load_image(path, keep_grey)


@lru_cache(maxsize=1)
def _decoded(path: str, modified: int) -> Any:
    """Decode a file, and keep it for the next window; `modified` tells its versions apart."""
    with open_picture(Path(path), MAX_SIDE) as picture:
        picture.load()
        return picture


def forget_pictures() -> None:
    """Free the memory of the file that Pillow decoded last."""
    _decoded.cache_clear()
    _loaded.cache_clear()

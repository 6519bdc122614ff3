"""Large images that are read by windows: TIFF and ``.npy`` files, arrays, and other decoded files.

Large TIFF files are written by tiles.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..backend.types import Record, Values
from ..gaussian.file import MAX_SET_SIDE
from ..image.formats import check_room, raise_reason
from ..image.io import is_pipe, read_image
from ..image.notes import tell, transparency_note
from ..image.pixels import (
    EncodedImage,
    ImageError,
    codes_of,
    data_of,
    floats_of,
    local_path,
    over_background,
)
from ..image.read import decode, has_windows, read_header, read_window

Pixels = Values
"""Pixels (h, w) or (h, w, channels) of any dtype."""


class Window(NamedTuple):
    """A part of an image that is read on demand, possibly in another process.

    Attributes
    ----------
    load : callable
        Returns the pixels in the dtype of the source. It holds a path, or the pixels.
    keep_grey : bool
        Whether the image is data, so that a grey one keeps one channel.
    name : str
        The image and the part, for errors.
    encoding : {"srgb", "linear"}
        The encoding of the pixels.
    """

    load: Callable[[], Pixels]
    keep_grey: bool
    name: str
    encoding: str = "srgb"

    def read(self) -> NDArray[np.float32]:
        """Return the pixels in float32: sRGB of shape (h, w, 3), or data of 1 or 3 channels.

        Raises
        ------
        ImageError
            If the file cannot be read, a pixel is not finite, or sRGB is far outside [0, 1].
        """
        part = EncodedImage(self.load(), self.encoding, self.name)
        return data_of(part) if self.keep_grey else codes_of(floats_of(part))


@dataclass(frozen=True)
class Source:
    """A large image.

    Attributes
    ----------
    width, height : int
        Size in pixels.
    channels : int
        Number of channels of a fit: 1 or 3.
    name : str
        The path of the file, or "image".
    identity : dict
        Numbers and strings that identify the image.
    pixels : str or array
        The path of a file that is read by windows; or an array with ``pixels[rows, columns]``.
    keep_grey, encoding
        See `Window`.
    """

    width: int
    height: int
    channels: int
    name: str
    identity: Record
    pixels: Any
    keep_grey: bool
    encoding: str = "srgb"

    def window(self, rows: slice, columns: slice) -> Window:
        """Return a part of the image."""
        part = f"rows {rows.start} to {rows.stop}, columns {columns.start} to {columns.stop}"
        if isinstance(self.pixels, str):
            load = partial(_read_part, self.pixels, rows, columns)
        else:
            load = partial(np.asarray, np.asarray(self.pixels[rows, columns]))
        return Window(load, self.keep_grey, f"{self.name}, {part}", self.encoding)


def open_source(source: Any, keep_grey: bool = False, encoding: str | None = None) -> Source:
    """Open a large image without reading its pixels.

    Parameters
    ----------
    source : path-like or array
        TIFF files with strips or tiles and ``.npy`` files are read by windows. Other files (PNG,
        JPEG, unusual TIFF) are decoded completely: 8-bit colours take 6 to 10 bytes per pixel
        during decoding, and 3 afterwards. An array (H, W, 3), (H, W, 1) or (H, W) has a dtype that
        `eigengs_dr.load_image` supports, and is read by slices
        ``source[top:bottom, left:right]``: an array of NumPy (also memory-mapped), zarr or Dask.
    keep_grey : bool, optional
        Whether the image is data, so that a grey one has one channel instead of three.
    encoding : {"srgb", "linear"}, optional
        The encoding of the pixels. By default that of the image: "linear" for files of floats.

    Returns
    -------
    Source

    Raises
    ------
    ImageError
        If there is no such file, it is not an image, or the shape or the size is wrong.
    """
    if isinstance(source, (str, os.PathLike)) and not is_pipe(source):
        name, file = str(source), local_path(source)
        identity = _identity(file)
        shape, pixels, file_encoding = _open_file(file, keep_grey)
        encoding = encoding or file_encoding
    else:
        pixels, encoding, name = read_image(source, keep_grey, encoding)
        if not (hasattr(pixels, "shape") and hasattr(pixels, "dtype")):
            kind = type(pixels).__name__
            raise ImageError(f"image: is a {kind}; pass a file or an array of shape (H, W, 3)")
        shape = tuple(int(side) for side in pixels.shape)
        identity = {"shape": list(shape), "dtype": np.dtype(pixels.dtype).str}
    if len(shape) not in (2, 3) or (len(shape) == 3 and shape[2] not in (1, 3)):
        raise ImageError(f"{name}: shape {shape}, expected (H, W) or (H, W, 3)")
    _check_sides(name, shape)
    channels = 1 if keep_grey and shape[2:] in ((), (1,)) else 3
    height, width = shape[:2]
    return Source(width, height, channels, name, identity, pixels, keep_grey, encoding or "srgb")


def _identity(path: Path) -> Record:
    """Return properties that identify the current version of a file."""
    try:
        state = path.stat()
    except OSError as error:
        raise ImageError(f"{path}: {error.strerror or error}; check the path") from None
    if path.is_dir():
        raise ImageError(f"{path}: is a folder; give an image file in it")
    return {
        "file": os.path.abspath(path),
        "bytes": state.st_size,
        "modified": state.st_mtime_ns,
    }


def _open_file(path: Path, keep_grey: bool) -> tuple[tuple[int, ...], str | Pixels, str]:
    """Return the shape of an image file, its `Source.pixels`, and its encoding."""
    absolute = os.path.abspath(path)
    if path.suffix.lower() == ".npy":
        try:
            stored = np.load(path, mmap_mode="r", allow_pickle=False)
        except (ValueError, EOFError, OSError) as error:
            raise ImageError(f"{path}: not a readable .npy file ({error})") from None
        return stored.shape, absolute, "linear" if stored.dtype.kind == "f" else "srgb"
    header = read_header(path)
    shape = header.height, header.width, header.channels
    _check_sides(str(path), shape)
    pixels: str | Pixels = absolute
    if has_windows(path, header):
        shown = transparency_note(header.alpha)
    else:
        header.check_memory(path, as_floats=False)  # 8-bit files are not converted to floats
        pixels, shown = over_background(*decode(path, header, keep_grey))
    for note in (*header.notes, *shown):
        tell(str(path), note)
    return shape, pixels, header.encoding


def _check_sides(name: str, shape: tuple[int, ...]) -> None:
    if not all(1 <= side <= MAX_SET_SIDE for side in shape[:2]):
        raise ImageError(
            f"{name}: {shape[1]}x{shape[0]} pixels; sides must be from 1 to {MAX_SET_SIDE:,}"
        )


def _read_part(path: str, rows: slice, columns: slice) -> Pixels:
    """Read a part of a file that is read by windows; the file is not mapped after the call."""
    if path.lower().endswith(".npy"):
        return np.array(np.load(path, mmap_mode="r", allow_pickle=False)[rows, columns])
    return read_window(path, rows, columns)


TILE_SIDE = 256
"""Side of the tiles of files that `write_tiles` writes, in pixels."""


def image_size(path: Path) -> tuple[int, int, int] | None:
    """Return height, width and channels (1 or 3) from the header of an image file.

    None for a pipe, which can be read only once, and for a file that is not an image.
    """
    if is_pipe(path):
        return None
    try:
        header = read_header(Path(path))
    except ImageError:
        return None
    return header.height, header.width, header.channels


def write_tiles(
    path: str | os.PathLike[str],
    shape: tuple[int, int, int],
    bands: Iterator[Pixels],
    dtype: DTypeLike = np.uint8,
) -> None:
    """Write a tiled TIFF file, a BigTIFF if it has more than 4 GB, from bands of rows.

    Parameters
    ----------
    path : path-like
    shape : (int, int, int)
        Height, width and number of channels, 1 or 3.
    bands : iterator of ndarray, shape (R, W, C)
        From top to bottom; every band except the last has a multiple of `TILE_SIDE` rows.
    dtype : dtype, optional
        Type of the bands: uint8, uint16 or float32.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    import OpenImageIO as oiio

    height, width, channels = shape
    kind = "float" if np.dtype(dtype).kind == "f" else np.dtype(dtype).name
    spec = oiio.ImageSpec(width, height, channels, kind)
    spec.tile_width = spec.tile_height = TILE_SIDE
    spec.attribute("compression", "zip")
    if spec.image_bytes() > 4_000_000_000:
        spec.attribute("tiff:bigtiff", 1)
    file = oiio.ImageOutput.create("tiff")
    assert file is not None
    written, top = file.open(str(path), spec), 0
    for band in bands:
        place = (0, width, top, top + len(band), 0, 1)
        written = written and file.write_tiles(*place, np.ascontiguousarray(band))
        if not written:
            break
        top += len(band)
    reason = file.geterror().strip()
    if not (file.close() and written):
        raise_reason(Path(path), reason or file.geterror().strip())
    check_room(Path(path))

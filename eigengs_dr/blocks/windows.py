"""Large images, read by windows: TIFF and ``.npy`` files, arrays, and what Pillow decodes.

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

from ..image.formats import TIFF_SUFFIXES, kind_of, open_header, open_picture, picture_pixels
from ..image.io import ImageError, check_data, check_image, read_file
from ..image.pixels import encoding_of
from ..image.remote import is_url

MAX_SIDE = 1 << 16
"""Longest side of a set of Gaussians, in pixels."""

Pixels = NDArray[Any]
"""Pixels (h, w) or (h, w, channels) of any type."""


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

    load: Callable[[], Pixels]
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
    pixels : str or array
        The path of a file that is read by windows; or what ``pixels[rows, columns]`` is a part of.
    keep_grey, encoding, unit
        See `Window`.
    """

    width: int
    height: int
    channels: int
    name: str
    identity: dict[str, Any]
    pixels: Any
    keep_grey: bool
    encoding: str = "srgb"
    unit: float = 1.0

    def window(self, rows: slice, columns: slice) -> Window:
        """Return a part of the image."""
        part = f"rows {rows.start} to {rows.stop}, columns {columns.start} to {columns.stop}"
        if isinstance(self.pixels, str):
            load = partial(_read_part, self.pixels, rows, columns)
        else:
            load = partial(np.asarray, np.asarray(self.pixels[rows, columns]))
        return Window(load, self.keep_grey, f"{self.name}, {part}", self.encoding, self.unit)


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
        source, encoding = read_file(source, keep_grey, encoding)
    if isinstance(source, (str, os.PathLike)):
        name, identity = str(source), _identity(Path(source))
        shape, pixels, said = _open_file(Path(source), keep_grey)
        encoding = encoding or said
    elif hasattr(source, "shape") and hasattr(source, "dtype"):
        name, shape, pixels = "image", tuple(int(side) for side in source.shape), source
        identity = {"shape": list(shape), "dtype": np.dtype(source.dtype).str}
        encoding = encoding_of(source, encoding) or "srgb"
    else:
        kind = type(source).__name__
        raise ImageError(f"image: is a {kind}; pass a file or an array of shape (H, W, 3)")
    if len(shape) not in (2, 3) or (len(shape) == 3 and shape[2] not in (1, 3)):
        raise ImageError(f"{name}: shape {shape}, expected (H, W) or (H, W, 3)")
    if not all(1 <= side <= MAX_SIDE for side in shape[:2]):
        raise ImageError(f"{name}: {shape[1]}x{shape[0]} pixels; sides go from 1 to {MAX_SIDE:,}")
    channels = 1 if keep_grey and shape[2:] in ((), (1,)) else 3
    return Source(shape[1], shape[0], channels, name, identity, pixels, keep_grey, encoding)


def _identity(path: Path) -> dict[str, Any]:
    """Return what tells a file from others, and from itself when it has changed."""
    try:
        state = path.stat()
    except OSError as error:
        raise ImageError(f"{path}: {error.strerror or error}; check the path") from None
    if path.is_dir():
        raise ImageError(f"{path}: is a folder; name an image file in it")
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
            shape = np.load(path, mmap_mode="r", allow_pickle=False).shape
        except (ValueError, EOFError, OSError) as error:
            raise ImageError(f"{path}: not a readable .npy file ({error})") from None
        return shape, absolute, "srgb"
    if path.suffix.lower() in TIFF_SUFFIXES and (found := window_shape(absolute)):
        return found[0], absolute, "linear" if found[1].kind == "f" else "srgb"
    if kind_of(path) is not None:
        pixels, encoding = read_file(path, keep_grey)
    else:  # 8 bits stay 8 bits
        with open_picture(path, MAX_SIDE) as picture:
            pixels, encoding = picture_pixels(picture)[0], "srgb"
    return pixels.shape, pixels, encoding


def _read_part(path: str, rows: slice, columns: slice) -> Pixels:
    """Read a part of a file that is read by windows; maps of the file end with the call."""
    if path.lower().endswith(".npy"):
        return np.array(np.load(path, mmap_mode="r", allow_pickle=False)[rows, columns])
    return read_window(path, rows, columns)


MAX_SEGMENT = 1 << 26
"""Values of the largest strip or tile that is decoded for a window. A file of one compressed strip
is better decoded once."""

TILE_SIDE = 256
"""Side of the tiles of files that `write_tiles` writes, in pixels."""


def window_shape(path: str) -> tuple[tuple[int, int, int], np.dtype[Any]] | None:
    """Return height, width, channels and the type of a TIFF file that `read_window` reads, or None.

    Such a file holds grey or RGB as 8 or 16 bits or floats. Its strips or tiles are plain, or have
    a compression that tifffile knows here: others need the package imagecodecs.
    """
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            page = file.pages[0]
            channels = page.samplesperpixel
            plain = page.planarconfig == 1 and page.photometric in (1, 2) and page.imagedepth == 1
            turned = "Orientation" in page.tags and page.tags["Orientation"].value != 1
            known = page.dtype is not None and page.dtype.str[1:] in ("u1", "u2", "f4", "f2", "f8")
            if not plain or turned or not known or channels not in (1, 3):
                return None
            if not page.is_memmappable:
                if np.prod(page.chunks, dtype=np.int64) > MAX_SEGMENT:
                    return None
                _decode(file, page, 0)
            return (page.imagelength, page.imagewidth, channels), page.dtype
    except Exception:  # tifffile raises many types; Pillow reads what it does not, or says why not
        return None


def read_window(path: str, rows: slice, columns: slice) -> Pixels:
    """Read a part of a TIFF file for which `window_shape` returns a shape.

    Parameters
    ----------
    path : str
    rows, columns : slice
        Inside the image.

    Returns
    -------
    ndarray, shape (R, C, channels) or (R, C)

    Raises
    ------
    ImageError
        If the file is missing or damaged.
    """
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            page = file.pages[0]
            if not page.is_memmappable:
                return _from_segments(file, page, rows, columns)
        whole = tifffile.memmap(path, page=0, mode="r")
        return np.array(whole[rows, columns], whole.dtype.newbyteorder("="))
    except Exception as error:  # tifffile raises many types
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ImageError(f"{path}: damaged or unreadable ({reason}); export it again") from error


def _from_segments(file: Any, page: Any, rows: slice, columns: slice) -> Pixels:
    """Decode the strips or tiles that a window touches. One without data is black."""
    height, width = page.chunks[:2]
    across = -(-page.imagewidth // width)
    shape = (rows.stop - rows.start, columns.stop - columns.start, page.samplesperpixel)
    result = np.zeros(shape, page.dtype)
    for row in range(rows.start // height, -(-rows.stop // height)):
        for column in range(columns.start // width, -(-columns.stop // width)):
            segment = _decode(file, page, row * across + column)
            if segment is not None:
                here, there = _shared(rows, row * height, segment.shape[0])
                left, right = _shared(columns, column * width, segment.shape[1])
                result[here, left] = segment[there, right]
    return result


def _shared(part: slice, start: int, length: int) -> tuple[slice, slice]:
    """Return what a part shares with a segment, counted from the start of each."""
    first, last = max(part.start, start), min(part.stop, start + length)
    return slice(first - part.start, last - part.start), slice(first - start, last - start)


def _decode(file: Any, page: Any, number: int) -> Pixels | None:
    """Return a strip or a tile (R, C, channels)."""
    file.filehandle.seek(page.dataoffsets[number])
    data = file.filehandle.read(page.databytecounts[number])
    segment, _, _ = page.decode(data, number)
    return None if segment is None else np.asarray(segment[0])


GREY = ("1", "L", "I", "I;16", "I;16B", "I;16L", "F")
"""Modes of Pillow for opaque images of one channel."""

TURNED = range(5, 9)
"""EXIF orientations that swap width and height."""

ORIENTATION = 0x0112
"""EXIF tag of the orientation."""


def image_size(path: Path | str) -> tuple[int, int, int] | None:
    """Return height, width and channels, 1 or 3, from the header of an image file.

    None for a URL, which is read once, and for a file that is no image.
    """
    if isinstance(path, str):
        return None
    if path.suffix.lower() in TIFF_SUFFIXES and (found := window_shape(str(path))):
        return found[0]
    try:
        with open_header(path) as file:
            width, height = file.size
            # Pillow decodes a PNG file to find its EXIF data; they seldom turn it.
            turned = file.format != "PNG" and file.getexif().get(ORIENTATION) in TURNED
            channels = 1 if file.mode in GREY else 3
    except Exception:  # Pillow's decoders raise many types
        return None
    return (width, height, channels) if turned else (height, width, channels)


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
        Height, width and channels, 1 or 3.
    bands : iterator of ndarray, shape (R, W, C)
        From top to bottom; every band but the last has a multiple of `TILE_SIDE` rows.
    dtype : dtype, optional
        Type of the bands: uint8, uint16 or float32.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    import tifffile

    height, width, channels = shape
    large = height * width * channels * np.dtype(dtype).itemsize > 4_000_000_000
    with tifffile.TiffWriter(path, bigtiff=large) as file:
        file.write(
            _tiles(bands, width),
            shape=shape if channels > 1 else shape[:2],
            dtype=dtype,
            photometric="rgb" if channels > 1 else "minisblack",
            tile=(TILE_SIDE, TILE_SIDE),
            compression="zlib",
        )


def _tiles(bands: Iterator[Pixels], width: int) -> Iterator[Pixels]:
    """Cut bands into tiles; tifffile fills up those at the edges."""
    for band in bands:
        for top in range(0, len(band), TILE_SIDE):
            for left in range(0, width, TILE_SIDE):
                tile = band[top : top + TILE_SIDE, left : left + TILE_SIDE]
                yield tile[..., 0] if tile.shape[2] == 1 else tile

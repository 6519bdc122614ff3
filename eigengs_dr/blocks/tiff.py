"""Large TIFF files, read by windows and written by tiles."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..image.io import ImageError

MAX_SEGMENT = 1 << 26
"""Values of the largest strip or tile that is decoded for a window. A file of one compressed strip
is better decoded once."""

TIFF_SUFFIXES = (".tif", ".tiff")

TILE_SIDE = 256
"""Side of the tiles of files that `write_tiles` writes, in pixels."""

Pixels = NDArray[Any]


def window_shape(path: str) -> tuple[int, int, int] | None:
    """Return height, width and channels of a TIFF file that `read_window` reads, else None.

    Such a file holds grey or RGB as 8 or 16 bits or floats. Its strips or tiles are plain, or have
    a compression that tifffile knows here: others need the package imagecodecs.
    """
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            page = file.pages[0]
            height, width = page.imagelength, page.imagewidth
            channels = page.samplesperpixel
            plain = page.planarconfig == 1 and page.photometric in (1, 2) and page.imagedepth == 1
            turned = "Orientation" in page.tags and page.tags["Orientation"].value != 1
            known = page.dtype is not None and page.dtype.str[1:] in ("u1", "u2", "f4", "f2", "f8")
            if not plain or turned or not known or channels not in (1, 3):
                return None
            if not page.is_memmappable:
                segment = page.chunks[-3:] if page.is_tiled else page.chunks
                if np.prod(segment, dtype=np.int64) > MAX_SEGMENT:
                    return None
                _decode(file, page, 0)
    except Exception:  # tifffile raises many types; Pillow reads what it does not, or says why not
        return None
    return height, width, channels


def holds_floats(path: str) -> bool:
    """Return whether a TIFF file, for which `window_shape` returns a shape, holds floats."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        return bool(file.pages[0].dtype.kind == "f")


def read_window(path: str, rows: slice, columns: slice) -> Pixels:
    """Read a part of a TIFF file for which `window_shape` returns a shape.

    Parameters
    ----------
    path : str
    rows, columns : slice
        Inside the image.

    Returns
    -------
    ndarray, shape (R, C, channels)

    Raises
    ------
    ImageError
        If the file is missing or damaged.
    """
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            page = file.pages[0]
            if page.is_memmappable:
                # A map of its own, so that the pages of the file leave the memory with it.
                whole = np.memmap(
                    path,
                    page.dtype.newbyteorder(file.byteorder),
                    "r",
                    page.dataoffsets[0],
                    (page.imagelength, page.imagewidth, page.samplesperpixel),
                )
                return np.array(whole[rows, columns], whole.dtype.newbyteorder("="))
            return _from_segments(file, page, rows, columns)
    except Exception as error:  # tifffile raises many types
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ImageError(f"{path}: damaged or unreadable ({reason}); export it again") from error


def _from_segments(file: Any, page: Any, rows: slice, columns: slice) -> Pixels:
    """Decode the strips or tiles that a window touches."""
    if page.is_tiled:
        height, width = page.tilelength, page.tilewidth
    else:
        height, width = page.rowsperstrip, page.imagewidth
    across = -(-page.imagewidth // width)
    shape = (rows.stop - rows.start, columns.stop - columns.start, page.samplesperpixel)
    result = np.empty(shape, page.dtype)
    for row in range(rows.start // height, -(-rows.stop // height)):
        for column in range(columns.start // width, -(-columns.stop // width)):
            segment = _decode(file, page, row * across + column)
            top, left = row * height, column * width
            y0, x0 = max(rows.start, top), max(columns.start, left)
            y1 = min(rows.stop, top + segment.shape[0])
            x1 = min(columns.stop, left + segment.shape[1])
            result[y0 - rows.start : y1 - rows.start, x0 - columns.start : x1 - columns.start] = (
                segment[y0 - top : y1 - top, x0 - left : x1 - left]
            )
    return result


def _decode(file: Any, page: Any, number: int) -> Pixels:
    """Return a strip or a tile (R, C, channels); a segment without data is black."""
    file.filehandle.seek(page.dataoffsets[number])
    data = file.filehandle.read(page.databytecounts[number])
    segment, _, shape = page.decode(data, number)
    if segment is None:
        return np.zeros(shape[1:], page.dtype)
    return np.asarray(segment[0])


def write_tiles(
    path: str | os.PathLike[str],
    shape: tuple[int, int, int],
    bands: Iterator[Pixels],
    dtype: Any = np.uint8,
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

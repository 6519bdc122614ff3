"""Rendering of regions and full pictures of large sets, part by part, and their PSNR."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ..backend.entry_points import entry_point
from ..backend.types import Values
from ..gaussian.file import SetData
from ..gaussian.gaussians import Gaussians
from ..image.color import exposed
from ..image.formats import TIFF_SUFFIXES
from ..image.io import bits_of, dtype_of, to_file, write_pixels
from ..image.metrics import squared_error
from ..raster.render import filter_by_box, picture_of, render
from ..storage.atomic import atomic_write
from .block import BlockSettings, BlockTask
from .windows import TILE_SIDE, write_tiles

BAND_PIXELS = 1 << 22
"""Number of pixels of a band that is rendered at once; a pixel takes about 100 bytes."""

Picture = Values


def draw(data: SetData, backend: str | None = None) -> Picture:
    """Render a set, which may be empty, at its native size, as `eigengs_dr.picture_of` does."""
    return picture_of(_load(data, backend))


def _load(data: SetData, backend: str | None) -> Gaussians:
    """Return the set; an empty set gets one Gaussian of colour 0."""
    if len(data.arrays["mean"]) == 0:
        channels = len(data.arrays["background"])
        data = data._replace(
            arrays=data.arrays
            | {
                "mean": np.zeros((1, 2), np.float32),
                "factor": np.array([[1, 0, 1]], np.float32),
                "color": np.zeros((1, channels), np.float32),
            }
        )
    return Gaussians.from_data(data, backend)


@entry_point
def _pixels_of(data: SetData, backend: str | None) -> Picture:
    return render(_load(data, backend)).numpy()


def draw_region(
    data: SetData,
    region: tuple[int, int, int, int],
    size: tuple[int, int],
    backend: str | None = None,
    kind: type[np.generic] = np.uint8,
) -> Iterator[Picture]:
    """Render a region of a set at any size, in bands of rows from top to bottom.

    A smaller picture is averaged, as by `eigengs_dr.render`. The memory is that of a band and of
    the set.

    Parameters
    ----------
    data : SetData
    region : (int, int, int, int)
        Left, top, width and height in native pixels of the set.
    size : (int, int)
        Width and height of the picture in pixels.
    backend : {"llvm", "cuda"}, optional
    kind : dtype, optional
        uint8 or uint16 for clamped and rounded sRGB, float32 for light; data is not converted.

    Yields
    ------
    ndarray of the dtype `kind`, shape (R, width, C)
        Every band except the last has a multiple of 256 rows.
    """
    left, top, native_width, native_height = region
    width, height = size
    scale = width / native_width, height / native_height
    if min(scale) < 1:  # before a Gaussian that becomes wider is left out
        data = filter_by_box(_load(data, backend), (1 / scale[0], 1 / scale[1])).data()
    if (native_width, native_height) != data.size:
        data = data.crop((left, top), (native_width, native_height))
    rows = max(1, BAND_PIXELS // width // TILE_SIDE) * TILE_SIDE
    for first in range(0, height, rows):
        band = width, min(rows, height - first)
        part = data.crop((0, first / scale[1]), band, scale)
        yield to_file(_pixels_of(part, backend), data.space.encoding, kind)


def save_region(
    path: Path,
    data: SetData,
    region: tuple[int, int, int, int],
    size: tuple[int, int],
    backend: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    bits: int | None = None,
) -> None:
    """Render a region of a set into a file atomically.

    Parameters
    ----------
    path : Path
        A .tif or .tiff file is written by tiles, in the memory of a band. Other files, see
        `eigengs_dr.save_image`, need the full picture in memory: 3 to 12 bytes per pixel.
    data, region, size, backend
        See `draw_region`.
    progress : callable, optional
        ``progress(done, total)``, counted in rows of the picture.
    bits : int, optional
        See `eigengs_dr.save_image`.

    Raises
    ------
    ImageError
        If the suffix is unknown, the format does not support the bits, or the file cannot be
        written.
    OSError
        If the .tif file cannot be written.
    """
    bits = bits_of(path, bits)
    kind = dtype_of(path, bits)
    shape = size[1], size[0], len(data.arrays["background"])

    def bands() -> Iterator[Picture]:
        done = 0
        for band in draw_region(data, region, size, backend, kind):
            yield band
            done += len(band)
            if progress:
                progress(done, shape[0])

    if path.suffix.lower() in TIFF_SUFFIXES:
        with atomic_write(path) as temporary:
            write_tiles(temporary, shape, bands(), kind)
        return
    picture, first = np.empty(shape, kind), 0
    for band in bands():
        picture[first : first + len(band)] = band
        first += len(band)
    write_pixels(path, picture, bits)


def block_errors(task: BlockTask, settings: BlockSettings) -> tuple[float, float]:
    """Return the sums of the squared errors of a block in the spaces of psnr_ycbcr and psnr_rgb."""
    assert task.arrays is not None
    pixels, affine, backend = task.window.read(), settings.affine, settings.options.backend
    size = pixels.shape[1], pixels.shape[0]
    data = SetData(task.arrays, size, settings.space, settings.options.method.cutoff)
    if not data.space.by_range:
        scaled = {name: data.arrays[name] * np.float32(affine.scale) for name in COLORS}
        scaled["background"] += np.float32(affine.offset)
        rendered = draw(data._replace(arrays=data.arrays | scaled), backend)
        rendered, pixels = (exposed(shown, settings.exposure) for shown in (rendered, pixels))
        floats = squared_error(rendered, pixels, data.space.figure)
        return floats, squared_error(rendered, pixels, "rgb")
    # Comparing in the unit of the fit avoids cancellation.
    rendered = draw(data, backend)
    values = (pixels - np.float32(affine.offset)) / np.float32(affine.scale)
    floats = squared_error(rendered, values, "data")
    if not settings.is_of_codes:
        return floats, math.nan
    floats *= affine.scale**2
    return floats, squared_error(rendered * affine.scale + affine.offset, pixels, "rgb")


COLORS = ("color", "background")
"""Arrays of a set in the unit of its colours."""

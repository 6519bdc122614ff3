"""TIFF files: every tag that changes the meaning of a pixel is applied, or rejected by name.

tifffile reads uncompressed, Deflate and LZMA segments, and all others with the package imagecodecs.
Files that it cannot read are passed to OpenImageIO, which supports LZW, PackBits, JPEG, the float
predictor and odd numbers of bits, and then to Pillow, which keeps 8 bits.
"""

from __future__ import annotations

import lzma
import zlib
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from .deep import read_openimageio
from .formats import has_openimageio
from .header import ORIENTATION, TRANSPOSED, Header, frames_note, over_background, profile_note
from .pictures import open_picture, picture_pixels
from .pixels import ImageError, peak_of, reason_of, scale
from .strips import Pixels, by_strips

if TYPE_CHECKING:
    from tifffile import TiffFile, TiffPage

COLORS = {0: "inverted", 1: "grey", 2: "rgb", 3: "palette", 5: "cmyk", 6: "ycbcr"}
"""Supported photometric interpretations."""

CHANNELS = {"rgb": 3, "cmyk": 4, "ycbcr": 3}
"""Number of samples of a colour, if it is more than 1."""

KINDS = {2: "signed integers", 5: "complex integers", 6: "complex numbers"}
"""Sample formats that are rejected."""

BITS = {"integers": (1, 2, 4, 8, 10, 12, 14, 16, 32), "floats": (16, 24, 32, 64)}
"""Supported numbers of bits per value."""

MAX_SEGMENT_VALUES = 1 << 26
"""Number of values of the largest strip or tile that is decoded for a window. A file that consists
of one compressed strip is better decoded once."""

DECOMPRESSORS: dict[int, Callable] = {
    8: zlib.decompressobj,
    32946: zlib.decompressobj,
    34925: lzma.LZMADecompressor,
}
"""Decompressors of the formats whose segments tifffile decodes without a limit of size."""

TRUSTED_SEGMENT_BYTES = 1 << 17
"""Size of a compressed segment that is decoded without a check: Deflate expands it to at most
130 MB."""


class Layout(NamedTuple):
    """The storage layout of the pixels of a page.

    Attributes
    ----------
    color : str
        One of the values of `COLORS`.
    bits : int
        Bits per sample.
    floats : bool
    samples : int
        Samples per pixel: first those of the colour, then others.
    alpha : int or None
        Index of the alpha sample.
    associated : bool
        Whether the colours are already multiplied by alpha.
    """

    color: str
    bits: int
    floats: bool
    samples: int
    alpha: int | None
    associated: bool

    @property
    def channels(self) -> int:
        """Number of channels of the image without alpha."""
        return 1 if self.color in ("grey", "inverted") else 3


def tiff_header(path: Path) -> Header:
    """Return the header of the first image of a file."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        page, _, pages = _first_page(file)
        layout = _layout(page)
        orientation = _tag(page, ORIENTATION, 1)
        width, height = page.imagewidth, page.imagelength
        encoding = "linear" if layout.floats else "srgb"
        notes = profile_note(_tag(page, 34675, b""), encoding) + frames_note(pages)
        others = layout.samples - CHANNELS.get(layout.color, 1) - (layout.alpha is not None)
        if others:
            notes += (f"{others} of {layout.samples} channels are no colours, and are left out",)
    if orientation in TRANSPOSED:
        width, height = height, width
    alpha = "none" if layout.alpha is None else ("associated" if layout.associated else "straight")
    needed = layout.samples * -(-layout.bits // 8)
    return Header(width, height, layout.channels, needed, encoding, orientation, alpha, notes)


def read_tiff(path: Path) -> Pixels:
    """Return the first image of a file: grey or RGB as stored, and alpha if there is one."""
    import tifffile
    from PIL import UnidentifiedImageError

    with tifffile.TiffFile(path) as file:
        page, number, _ = _first_page(file)
        layout = _layout(page)
        reason = f"{getattr(page.photometric, 'name', page.photometric)} colours"
        if layout.color != "ycbcr":
            try:
                _check_segments(file, page)
                samples = page.asarray(squeeze=False)[:, 0]
                samples = np.moveaxis(samples, 0, 2).reshape(*samples.shape[1:3], -1)
                return to_colors(_full_range(samples, layout), layout, page.colormap)
            except ImageError:
                raise
            except Exception as error:  # tifffile raises many types, also for missing codecs
                reason = reason_of(error)
    if layout.color != "ycbcr" and has_openimageio():
        with suppress(OSError):  # Pillow may be able to read it
            return _read_openimageio(path, number, layout)
    integers = not layout.floats and not layout.associated
    if integers and (layout.bits <= 8 or (layout.bits == 16 and layout.color == "grey")):
        with suppress(UnidentifiedImageError), open_picture(path) as image:
            image.seek(number)
            return picture_pixels(image)
    if "imagecodecs" in reason or "compression" in reason:
        name = getattr(page.compression, "name", page.compression)
        raise ImageError(
            f"compression {name} with {layout.bits} bits needs another package; type: "
            "pip install imagecodecs OpenImageIO, or export it with 8 or 16 bits, uncompressed"
        )
    raise ImageError(f"damaged or unsupported ({reason}); export it again")


def _read_openimageio(path: Path, number: int, layout: Layout) -> Pixels:
    """Read a page of a file with OpenImageIO, which scales integers to 8, 16 or 32 bits.

    It applies palettes, and inverts images whose white is 0 if they have at most 8 bits.
    """
    samples = read_openimageio(path, number)
    color = layout.color
    if color == "palette":
        color = "rgb"
    elif color == "inverted" and samples.dtype == np.uint8:
        color = "grey"
    layout = layout._replace(color=color, bits=8 * samples.dtype.itemsize)
    return to_colors(_full_range(samples, layout), layout, None)


def _first_page(file: TiffFile) -> tuple[TiffPage, int, int]:
    """Return the first page that is not a thumbnail or a mask, its index, and the number of images.

    The index counts all pages.
    """
    numbered = enumerate(cast("Iterable[TiffPage]", file.pages))
    pages = [(k, page) for k, page in numbered if not _tag(page, 254, 0) & 5]
    if not pages:
        raise ImageError("holds only a thumbnail, its image is in a sub-IFD; export it as TIFF")
    number, page = pages[0]
    return page, number, len(pages)


def _tag(page: TiffPage, code: int, default: object) -> Any:
    return page.tags[code].value if code in page.tags else default


def _layout(page: TiffPage) -> Layout:
    """Return the layout of a page; reject unsupported kinds by name."""
    color = COLORS.get(int(page.photometric))
    name = getattr(page.photometric, "name", page.photometric)
    if color is None:
        raise ImageError(f"holds {name} colours; convert it to RGB")
    bits, kind = page.bitspersample, int(page.sampleformat)
    floats, samples = kind == 3, page.samplesperpixel
    numbers = "floats" if floats else "integers"
    if kind in KINDS or bits not in BITS[numbers]:
        sample_type = KINDS.get(kind, numbers)
        raise ImageError(
            f"holds {sample_type} of {bits} bits; export it with 8 or 16 bits, or floats"
        )
    channel_bits = np.atleast_1d(_tag(page, 258, 1))
    if (channel_bits != channel_bits[0]).any():
        raise ImageError(f"its channels have {channel_bits.tolist()} bits; export it with 8 or 16")
    if page.imagedepth != 1:
        raise ImageError("holds a volume; export a slice of it")
    if (color == "ycbcr" and bits != 8) or (floats and color not in ("grey", "rgb")):
        raise ImageError(f"holds {name} colours as {numbers} of {bits} bits; convert it to RGB")
    if color == "cmyk" and _tag(page, 332, 1) != 1:
        raise ImageError("holds inks that are not CMYK; convert it to RGB")
    first = CHANNELS.get(color, 1)
    if samples < first:
        raise ImageError(f"holds {samples} channels, not {first} of {name}; export it again")
    extra = [int(kind) for kind in page.extrasamples[: samples - first]]
    alpha = next((k for k, kind in enumerate(extra) if kind in (1, 2)), None)
    associated = alpha is not None and extra[alpha] == 1
    place = None if alpha is None else first + alpha
    return Layout(color, bits, floats, samples, place, associated)


def to_colors(samples: Pixels, layout: Layout, palette: Pixels | None) -> Pixels:
    """Convert samples (H, W, S) of a page to grey or RGB, with alpha as the last channel, if any.

    Integers are those of `_full_range`.
    """
    first, color = CHANNELS.get(layout.color, 1), layout.color
    if color in ("grey", "rgb") and layout.alpha == first:
        return samples[..., : first + 1]
    colors = samples[..., :first]
    if color == "palette":
        table = np.asarray(palette)  # of 16 bits; viewers use the upper 8
        table = table >> 8 if table.max() > 255 else table
        colors = table.T.astype(np.uint8)[colors[..., 0]]
    elif color == "inverted":
        colors = 1 - colors if colors.dtype.kind == "f" else ~colors
    elif color == "cmyk":
        peak = peak_of(colors.dtype)
        colors = by_strips(lambda rows: _cmyk_to_rgb(rows, peak), colors, channels=3)
    if layout.alpha is None:
        return colors
    alpha = samples[..., layout.alpha : layout.alpha + 1]
    if alpha.dtype != colors.dtype:
        colors, alpha = (scale(part, peak_of(part.dtype)) for part in (colors, alpha))
    return np.concatenate([colors, alpha], axis=2)


def _full_range(samples: Pixels, layout: Layout) -> Pixels:
    """Scale integers of any number of bits to uint8 or uint16, 32-bit integers to floats.

    Palette indices and floats are not changed.
    """
    bits = layout.bits
    if layout.floats or layout.color == "palette" or bits in (8, 16):
        return samples
    if bits == 32:
        return by_strips(lambda rows: scale(rows, 2**32 - 1), samples)
    kind = np.uint8 if bits < 8 else np.uint16
    levels = np.rint(np.arange(2**bits) * (np.iinfo(kind).max / (2**bits - 1))).astype(kind)
    return levels[samples.astype(kind)]


def _cmyk_to_rgb(rows: Pixels, peak: int) -> Pixels:
    """Convert CMYK to RGB without a colour profile, as Pillow does."""
    rows = scale(rows, peak)
    return (1 - rows[..., :3]) * (1 - rows[..., 3:])


def _check_segments(file: TiffFile, page: TiffPage) -> None:
    """Reject segments that expand to more than their size: kilobytes may become gigabytes."""
    if page.compression not in DECOMPRESSORS:
        return
    size = int(np.prod(page.chunks)) * -(-page.bitspersample // 8) * (page.samplesperpixel + 1)
    for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
        if count > TRUSTED_SEGMENT_BYTES:
            file.filehandle.seek(offset)
            decoder = DECOMPRESSORS[page.compression]()
            if len(decoder.decompress(file.filehandle.read(count), size + 1)) > size:
                raise ImageError(
                    "damaged: a strip or tile holds more than its size; export it again"
                )


# ---------------------------------------------------------------------------------------------
#  Windows
# ---------------------------------------------------------------------------------------------


def has_windows(path: Path) -> bool:
    """Return whether `read_window` can read parts of a file whose header is valid.

    Its strips or tiles must be uncompressed, or have a compression that tifffile supports here, and
    the samples of a pixel must be interleaved.
    """
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            page, _, _ = _first_page(file)
            if _tag(page, ORIENTATION, 1) != 1 or page.planarconfig != 1:
                return False
            if _layout(page).color == "ycbcr" or page.bitspersample not in (8, 16, 24, 32, 64):
                return False
            if not page.is_memmappable:
                if np.prod(page.chunks, dtype=np.int64) > MAX_SEGMENT_VALUES:
                    return False
                _check_segments(file, page)
                _decode(file, page, 0)
            return True
    except Exception:  # tifffile raises many types; other readers may succeed or report why not
        return False


def read_window(path: str, rows: slice, columns: slice) -> Pixels:
    """Read a part of a TIFF file for which `has_windows` is true.

    Parameters
    ----------
    path : str
    rows, columns : slice
        Inside the image.

    Returns
    -------
    ndarray, shape (R, C, 1) or (R, C, 3)
        As from `eigengs_dr.load_image`, but in the type of the file.

    Raises
    ------
    ImageError
        If the file is missing or damaged.
    """
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            page, _, _ = _first_page(file)
            layout, palette = _layout(page), page.colormap
            if page.is_memmappable:
                image = page.asarray(out="memmap").reshape(page.imagelength, page.imagewidth, -1)
                samples = np.array(image[rows, columns], image.dtype.newbyteorder("="))
            else:
                samples = _from_segments(file, page, rows, columns)
        alpha = "associated" if layout.associated else "straight"
        pixels = to_colors(_full_range(samples, layout), layout, palette)
        return over_background(pixels, "none" if layout.alpha is None else alpha)[0]
    except Exception as error:  # tifffile raises many types
        reason = reason_of(error)
        raise ImageError(f"{path}: damaged or unreadable ({reason}); export it again") from error


def _from_segments(file: TiffFile, page: TiffPage, rows: slice, columns: slice) -> Pixels:
    """Decode the strips or tiles that a window touches. Segments without data are black."""
    height, width = page.chunks[:2]
    across = -(-page.imagewidth // width)
    shape = (rows.stop - rows.start, columns.stop - columns.start, page.samplesperpixel)
    result = np.zeros(shape, page.dtype)
    for row in range(rows.start // height, -(-rows.stop // height)):
        for column in range(columns.start // width, -(-columns.stop // width)):
            segment = _decode(file, page, row * across + column)
            if segment is not None:
                target_rows, source_rows = _overlap(rows, row * height, segment.shape[0])
                target_columns, source_columns = _overlap(columns, column * width, segment.shape[1])
                result[target_rows, target_columns] = segment[source_rows, source_columns]
    return result


def _overlap(part: slice, start: int, length: int) -> tuple[slice, slice]:
    """Return the overlap of a part and a segment, relative to the start of each."""
    first, last = max(part.start, start), min(part.stop, start + length)
    return slice(first - part.start, last - part.start), slice(first - start, last - start)


def _decode(file: TiffFile, page: TiffPage, number: int) -> Pixels | None:
    """Return a strip or a tile (R, C, channels)."""
    file.filehandle.seek(page.dataoffsets[number])
    data = file.filehandle.read(page.databytecounts[number])
    segment, _, _ = page.decode(data, number)
    return None if segment is None else np.asarray(segment[0])

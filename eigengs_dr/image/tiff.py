"""TIFF files: every tag that changes what a pixel means is followed, or refused by its name.

tifffile reads plain, Deflate and LZMA segments, and all others with the package imagecodecs. Where
it cannot, OpenImageIO is asked, which knows LZW, PackBits, JPEG, the predictor of floats and odd
numbers of bits; then Pillow, which keeps 8 bits.
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
from .header import ORIENTATION, TURNED, Header, frames_note, over_background, profile_note
from .pictures import open_picture, picture_pixels
from .pixels import ImageError, peak_of, reason_of, scale
from .strips import Pixels, by_strips

if TYPE_CHECKING:
    from tifffile import TiffFile, TiffPage

COLORS = {0: "inverted", 1: "grey", 2: "rgb", 3: "palette", 5: "cmyk", 6: "ycbcr"}
"""Photometric interpretations that are read."""

CHANNELS = {"rgb": 3, "cmyk": 4, "ycbcr": 3}
"""Samples of a colour, where they are more than 1."""

KINDS = {2: "signed integers", 5: "complex integers", 6: "complex numbers"}
"""Sample formats that are refused."""

BITS = {"integers": (1, 2, 4, 8, 10, 12, 14, 16, 32), "floats": (16, 24, 32, 64)}
"""Bits of a value that are read."""

MAX_SEGMENT = 1 << 26
"""Values of the largest strip or tile that is decoded for a window. A file of one compressed strip
is better decoded once."""

UNBOUNDED: dict[int, Callable] = {
    8: zlib.decompressobj,
    32946: zlib.decompressobj,
    34925: lzma.LZMADecompressor,
}
"""Compressions whose segments tifffile decodes to whatever size they have."""

TRUSTED_SEGMENT = 1 << 17
"""Bytes of a segment that is decoded at once: Deflate makes 130 MB of it at most."""


class Layout(NamedTuple):
    """How a page stores its pixels.

    Attributes
    ----------
    color : str
        One of the values of `COLORS`.
    bits : int
        Bits of a sample.
    floats : bool
    samples : int
        Samples of a pixel: those of the colour, then others.
    alpha : int or None
        The sample that is alpha.
    associated : bool
        Whether the colours are multiplied by alpha already.
    """

    color: str
    bits: int
    floats: bool
    samples: int
    alpha: int | None
    associated: bool

    @property
    def channels(self) -> int:
        """Channels of the picture without alpha."""
        return 1 if self.color in ("grey", "inverted") else 3


def tiff_header(path: Path) -> Header:
    """Return what the first image of a file says."""
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
    if orientation in TURNED:
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
                return to_colors(_whole_range(samples, layout), layout, page.colormap)
            except ImageError:
                raise
            except Exception as error:  # tifffile raises many types, also for missing codecs
                reason = reason_of(error)
    if layout.color != "ycbcr" and has_openimageio():
        with suppress(OSError):  # Pillow may know it
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

    It looks palettes up, and inverts up to 8 bits where white is 0, and no more.
    """
    samples = read_openimageio(path, number)
    color = layout.color
    if color == "palette":
        color = "rgb"
    elif color == "inverted" and samples.dtype == np.uint8:
        color = "grey"
    layout = layout._replace(color=color, bits=8 * samples.dtype.itemsize)
    return to_colors(_whole_range(samples, layout), layout, None)


def _first_page(file: TiffFile) -> tuple[TiffPage, int, int]:
    """Return the first page that is no small copy or mask of another, its number, and their count.

    The number counts all pages, the count those that are images.
    """
    numbered = enumerate(cast("Iterable[TiffPage]", file.pages))
    pages = [(k, page) for k, page in numbered if not _tag(page, 254, 0) & 5]
    if not pages:
        raise ImageError("holds a thumbnail alone, its image is in a sub-IFD; export it as TIFF")
    number, page = pages[0]
    return page, number, len(pages)


def _tag(page: TiffPage, code: int, default: object) -> Any:
    return page.tags[code].value if code in page.tags else default


def _layout(page: TiffPage) -> Layout:
    """Return how a page stores its pixels; refuse by name what has no meaning here."""
    color = COLORS.get(int(page.photometric))
    name = getattr(page.photometric, "name", page.photometric)
    if color is None:
        raise ImageError(f"holds {name} colours; convert it to RGB")
    bits, kind = page.bitspersample, int(page.sampleformat)
    floats, samples = kind == 3, page.samplesperpixel
    numbers = "floats" if floats else "integers"
    if kind in KINDS or bits not in BITS[numbers]:
        what = KINDS.get(kind, numbers)
        raise ImageError(f"holds {what} of {bits} bits; export it with 8 or 16 bits, or floats")
    each = np.atleast_1d(_tag(page, 258, 1))
    if (each != each[0]).any():
        raise ImageError(f"its channels have {each.tolist()} bits; export it with 8 or 16")
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

    Integers are those of `_whole_range`.
    """
    first, color = CHANNELS.get(layout.color, 1), layout.color
    if color in ("grey", "rgb") and layout.alpha == first:
        return samples[..., : first + 1]
    colors = samples[..., :first]
    if color == "palette":
        table = np.asarray(palette)  # of 16 bits, of which viewers take the upper 8
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


def _whole_range(samples: Pixels, layout: Layout) -> Pixels:
    """Scale integers of any number of bits to uint8 or uint16, or those of 32 to floats.

    Indices of a palette and floats stay.
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
    """Convert inks to colours as Pillow does: without a profile."""
    rows = scale(rows, peak)
    return (1 - rows[..., :3]) * (1 - rows[..., 3:])


def _check_segments(file: TiffFile, page: TiffPage) -> None:
    """Refuse segments that unfold to more than their size: a few kilobytes may make gigabytes."""
    if page.compression not in UNBOUNDED:
        return
    size = int(np.prod(page.chunks)) * -(-page.bitspersample // 8) * (page.samplesperpixel + 1)
    for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
        if count > TRUSTED_SEGMENT:
            file.filehandle.seek(offset)
            decoder = UNBOUNDED[page.compression]()
            if len(decoder.decompress(file.filehandle.read(count), size + 1)) > size:
                raise ImageError(
                    "damaged: a strip or tile holds more than its size; export it again"
                )


# ---------------------------------------------------------------------------------------------
#  Windows
# ---------------------------------------------------------------------------------------------


def has_windows(path: Path) -> bool:
    """Return whether `read_window` reads parts of a file whose header is known to be good.

    Its strips or tiles are plain, or have a compression that tifffile knows here, and their samples
    lie side by side.
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
                if np.prod(page.chunks, dtype=np.int64) > MAX_SEGMENT:
                    return False
                _check_segments(file, page)
                _decode(file, page, 0)
            return True
    except Exception:  # tifffile raises many types; other readers know it, or say why not
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
        As `eigengs_dr.load_image` shows them, in the type of the file.

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
                whole = page.asarray(out="memmap").reshape(page.imagelength, page.imagewidth, -1)
                samples = np.array(whole[rows, columns], whole.dtype.newbyteorder("="))
            else:
                samples = _from_segments(file, page, rows, columns)
        alpha = "associated" if layout.associated else "straight"
        pixels = to_colors(_whole_range(samples, layout), layout, palette)
        return over_background(pixels, "none" if layout.alpha is None else alpha)[0]
    except Exception as error:  # tifffile raises many types
        reason = reason_of(error)
        raise ImageError(f"{path}: damaged or unreadable ({reason}); export it again") from error


def _from_segments(file: TiffFile, page: TiffPage, rows: slice, columns: slice) -> Pixels:
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


def _decode(file: TiffFile, page: TiffPage, number: int) -> Pixels | None:
    """Return a strip or a tile (R, C, channels)."""
    file.filehandle.seek(page.dataoffsets[number])
    data = file.filehandle.read(page.databytecounts[number])
    segment, _, _ = page.decode(data, number)
    return None if segment is None else np.asarray(segment[0])

"""Image files: OpenImageIO reads the kinds of `formats.STARTS`, Pillow the others.

Pillow is also asked for the pixels of files where OpenImageIO fails: it decodes TIFF of Zstandard,
and JPEG with stray bytes. Headers are read, and the memory is checked, before any pixel is decoded.
"""

from __future__ import annotations

import math
import re
import stat
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple, TypeGuard

import numpy as np

from ..backend.messages import printable
from ..storage.memory import check_content
from .formats import HAS_HEIF, HEIF_SUFFIXES, STARTS
from .notes import GAIN_MAP, depth_notes, png_notes, primaries_note, profile_note
from .pixels import ImageError, Pixels, by_strips, over_background, reason_of, scale_to_white

if TYPE_CHECKING:
    import OpenImageIO as oiio
    from PIL.Image import Image

TRANSPOSED = range(5, 9)
"""EXIF orientations that swap width and height."""

ORIENTATION, EXIF, COLOR_SPACE = 0x0112, 0x8769, 0xA001
"""Tags of EXIF: the orientation, the main folder, the colour space in it."""


class Header(NamedTuple):
    """The header of an image file: the properties of its pixels.

    Attributes
    ----------
    width, height : int
        Size in pixels, after the orientation is applied if `upright`.
    channels : int
        1 for grey, 3 for colours; alpha does not count.
    bytes_per_pixel : int
        Memory that decoding takes, in bytes per pixel.
    depth : int
        Bits of a value that OpenImageIO decodes.
    encoding : {"srgb", "linear"}
    orientation : int
        EXIF orientation of the pixels as they are stored; 1 for those that Pillow turns itself.
    alpha : {"none", "straight", "associated", "light"}
        Whether the last decoded channel is alpha. Colours may already be multiplied by it, as sRGB
        ("associated") or as light, which is then shown over black ("light").
    notes : tuple of str
        Warnings about the file.
    upright : bool
        Whether `decode` applies the orientation.
    kind : str or None
        OpenImageIO's name of the format; None if Pillow reads the file.
    """

    width: int
    height: int
    channels: int
    bytes_per_pixel: int
    depth: int = 8
    encoding: str = "srgb"
    orientation: int = 1
    alpha: str = "none"
    notes: tuple[str, ...] = ()
    upright: bool = True
    kind: str | None = None

    def check_memory(self, path: Path, as_floats: bool = True) -> None:
        """Reject a file whose pixels take too much memory; see `check_content`.

        Raises
        ------
        ImageError
        """
        bytes_per_pixel = self.bytes_per_pixel
        if as_floats:
            bytes_per_pixel = max(bytes_per_pixel, 4 * self.channels)
        try:
            check_content(path, self.width * self.height * bytes_per_pixel)
        except ValueError as error:
            raise ImageError(str(error)) from None


class _Unread(Exception):
    """OpenImageIO cannot read a file."""


def read_header(path: Path, upright: bool = True) -> Header:
    """Return the header of an image file; no pixel is decoded.

    Parameters
    ----------
    path : Path
    upright : bool, optional
        Whether the EXIF orientation counts. The order of pixels in a Radiance file always does.

    Raises
    ------
    ImageError
        If the header cannot be read or is not supported; see `load_image`.
    """
    with _image_errors(path):
        kind = _format_of(path)
        if not kind:
            return _picture_header(path, upright)
        with _opened(path, kind) as file:
            if not _has_gain_map(file):
                return _header(path, file, upright)
        header = _picture_header(path, upright)
        return header._replace(notes=header.notes + GAIN_MAP)


def decode(path: Path, header: Header, keep_grey: bool) -> tuple[Pixels, str]:
    """Return the pixels of a file, grey or RGB in its type, and what their alpha is.

    For errors see `load_image`.
    """
    with _image_errors(path):
        if header.kind == "openexr" and header.channels == 1 and not keep_grey:
            raise ImageError(
                "holds one channel, not R, G and B; read it as data (keep_grey=True, "
                "--space data), or export it as RGB"
            )
        if header.kind:
            return _pixels(path, header, header.kind)
        return _picture(path, header.upright)


def _format_of(path: Path) -> str | None:
    """Return OpenImageIO's name of the format of a file by its first bytes; None is for Pillow.

    Raises
    ------
    OSError
        If the file cannot be opened.
    """
    start = _start_of(path, 8)
    kind = next((kind for first, kind in STARTS.items() if start.startswith(first)), None)
    return None if kind == "pnm" and not start[2:3].isspace() else kind


def _start_of(path: Path, length: int) -> bytes:
    """Return the first bytes of a file."""
    with path.open("rb") as file:
        return file.read(length)


@contextmanager
def _image_errors(path: Path) -> Iterator[None]:
    """Convert errors of a block that reads a file to `ImageError`s that name the file."""
    try:
        state = path.stat()
        if stat.S_ISCHR(state.st_mode) or stat.S_ISBLK(state.st_mode):
            raise ImageError("is a device; give an image file")
        if state.st_size == 0 and stat.S_ISREG(state.st_mode):
            raise ImageError("the file is empty (0 bytes); copy or export it again")
        yield
    except ImageError as error:
        text = str(error)
        raise ImageError(
            text if text.startswith(printable(f"{path}: ")) else f"{path}: {text}"
        ) from None
    except Exception as error:  # on damaged files decoders raise many types
        from PIL import UnidentifiedImageError

        reason = reason_of(error)
        unknown = "not an image that Pillow knows; save it as PNG or JPEG"
        if path.suffix.lower() in HEIF_SUFFIXES and not HAS_HEIF:
            unknown = "needs pillow-heif; type: pip install pillow-heif"
        messages = {
            FileNotFoundError: "no such file; check the path",
            IsADirectoryError: "is a folder; give an image file in it",
            PermissionError: "permission denied; check its permissions",
            UnidentifiedImageError: unknown,
        }
        damaged = f"damaged or unsupported ({reason}); export it again"
        text = next((text for kind, text in messages.items() if isinstance(error, kind)), damaged)
        raise ImageError(f"{path}: {text}") from error


def oriented(pixels: Pixels, orientation: int) -> Pixels:
    """Apply an EXIF orientation to decoded pixels (H, W, C); returns a view."""
    if orientation in TRANSPOSED:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return pixels[:, ::-1] if orientation in (2, 3, 6, 7) else pixels


def _frames_note(frames: int) -> tuple[str, ...]:
    return (f"holds {frames} frames, the first is used",) if frames > 1 else ()


# ---------------------------------------------------------------------------------------------
#  OpenImageIO
# ---------------------------------------------------------------------------------------------


@contextmanager
def _opened(path: Path, kind: str) -> Iterator[oiio.ImageInput]:
    """Open a file at its first image that is no thumbnail or mask, with alpha as it is stored."""
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    if kind == "png":
        _check_png(path, b"IDAT")
    with _text_of(path) as name:
        file = oiio.ImageInput.open(name, config)
    if not file:
        raise _Unread(oiio.geterror().strip())
    try:
        if file.format_name() != kind:  # some go by the suffix alone
            raise ImageError(f"its suffix {path.suffix} is that of other files; rename it")
        while _is_reduced(file.spec()):
            if not file.seek_subimage(file.current_subimage() + 1, 0):
                raise ImageError(
                    "holds only a thumbnail, its image is in a sub-IFD; export it as TIFF"
                )
        yield file
    finally:
        file.geterror()  # else OpenImageIO prints it
        file.close()


@contextmanager
def _text_of(path: Path) -> Iterator[str]:
    """Yield the name of a file, or that of a link to it if it is not UTF-8."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        with TemporaryDirectory() as folder:
            link = Path(folder) / "image"
            link.symlink_to(path.absolute())
            yield str(link)
    else:
        yield str(path)


def _is_reduced(spec: oiio.ImageSpec) -> bool:
    """Return whether an image is a thumbnail or a mask, by its TIFF tag."""
    return bool((spec.getattribute("tiff:subfiletype") or 0) & 5)


def _header(path: Path, file: oiio.ImageInput, upright: bool) -> Header:
    """Return the header of an open file; reject kinds that are not pictures by name."""
    spec, kind = file.spec(), file.format_name()
    if kind == "tiff":
        _check_tiff(spec)
    elif kind == "openexr":
        _check_exr(spec)
    colors, alpha = _colors_of(spec), _alpha_of(file)
    encoding = "linear" if str(spec.format) in FLOATS else "srgb"
    size, orientation = (spec.width, spec.height), spec.getattribute("Orientation")
    profile = spec.getattribute("ICCProfile")
    space = spec.getattribute("Exif:ColorSpace")
    notes = profile_note(b"" if profile is None else bytes(profile), encoding, space)
    if kind == "openexr":
        size = spec.full_width, spec.full_height
        notes += _exr_notes(spec)
        if file.seek_subimage(1, 0):
            raise ImageError("holds several parts; save one as a file of its own")
    elif kind == "hdr":
        (orientation, more), upright = _radiance(path), True
        notes += more
    elif kind == "png":
        notes += png_notes(spec) + _frames_note(_png_frames(path))
    elif kind == "pnm" and path.stat().st_size > 2 * spec.image_bytes(True) + MAX_TEXT:
        several = spec.getattribute("pnm:binary")  # text may have any length
        notes += ("holds several images, the first is used",) if several else ()
    elif kind == "tiff":
        others = spec.nchannels - colors - (alpha != "none")
        if others:
            notes += (f"{others} of {spec.nchannels} channels are no colours, and are left out",)
        notes += _frames_note(_count_images(file))
    orientation = orientation if orientation in range(1, 9) else 1
    width, height = size[::-1] if upright and orientation in TRANSPOSED else size
    stored, depth = spec.pixel_bytes(True), 8 * spec.format.size()
    needed = stored if encoding == "linear" else 2 * stored  # decoders hold a second copy
    if _display(spec) != _data(spec):
        needed += math.ceil(stored * spec.width * spec.height / max(1, math.prod(size)))
    if alpha in ("straight", "associated"):
        needed = max(needed, stored + 4 * colors)
    pixels = (colors, needed, depth, encoding, orientation, alpha)
    return Header(width, height, *pixels, notes, upright, kind)


FLOATS = ("half", "float", "double")
"""OpenImageIO's names of floats, which are light."""


def _has_gain_map(file: oiio.ImageInput) -> bool:
    """Return whether OpenImageIO makes light of codes, as it does for JPEG with a gain map."""
    return file.format_name() in ("jpeg", "png") and str(file.spec().format) in FLOATS


def _colors_of(spec: oiio.ImageSpec) -> int:
    """Return the number of channels that are colours: 1 for grey, else 3."""
    is_grey = spec.getattribute("tiff:PhotometricInterpretation") in (0, 1)
    return 1 if is_grey or spec.nchannels < 3 else 3


def _alpha_of(file: oiio.ImageInput) -> str:
    """Return what the alpha of an image is, see `Header`."""
    spec = file.spec()
    if not 0 <= spec.alpha_channel < spec.nchannels:
        return "none"
    if file.format_name() == "openexr":
        return "light"
    return "straight" if spec.getattribute("oiio:UnassociatedAlpha") else "associated"


def _check_tiff(spec: oiio.ImageSpec) -> None:
    """Reject kinds of TIFF by name that OpenImageIO does not convert to grey or RGB."""
    kind, bits = str(spec.format), 8 * spec.format.size()
    floats = kind in FLOATS
    if kind.startswith("int"):
        raise ImageError(
            f"holds signed integers of {bits} bits; export it with 8 or 16 bits, or floats"
        )
    if spec.depth != 1:
        raise ImageError("holds a volume; export a slice of it")
    name = spec.getattribute("tiff:ColorSpace")
    if name == "color separated":
        raise ImageError("holds inks that are not CMYK; convert it to RGB")
    if name not in (None, "palette", "CMYK", "YCbCr"):
        raise ImageError(f"holds {name} colours; convert it to RGB")
    if spec.getattribute("tiff:PhotometricInterpretation") == 0:
        name = "MINISWHITE"
    bits = spec.getattribute("oiio:BitsPerSample") or bits
    if (name and floats) or (name == "YCbCr" and bits != 8):
        numbers = "floats" if floats else "integers"
        raise ImageError(f"holds {name} colours as {numbers} of {bits} bits; convert it to RGB")


def _count_images(file: oiio.ImageInput) -> int:
    """Return the number of images of a file, from the current one on, without thumbnails."""
    count, number = 1, file.current_subimage() + 1
    while file.seek_subimage(number, 0):
        count += not _is_reduced(file.spec())
        number += 1
    return count


def _check_exr(spec: oiio.ImageSpec) -> None:
    """Reject EXR files by name that are not pictures."""
    names = tuple(spec.channelnames)
    if spec.deep:
        raise ImageError("holds deep pixels; flatten it first")
    if len(names) > 1 and names not in (("R", "G", "B"), ("R", "G", "B", "A")):
        listed = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
        raise ImageError(
            f"holds the channels {listed}; save the layer that is meant, as R, G and B, "
            "to a file of its own"
        )
    if str(spec.format) not in FLOATS:
        raise ImageError("holds object IDs instead of colours; convert it to floats")


def _exr_notes(spec: oiio.ImageSpec) -> tuple[str, ...]:
    primaries = spec.getattribute("chromaticities")
    notes = () if primaries is None else primaries_note(primaries, 0.01)
    if _display(spec) != _data(spec):
        notes += ("its display window is shown, and what it lacks is black",)
    return notes


def _display(spec: oiio.ImageSpec) -> tuple[int, int, int, int]:
    return spec.full_x, spec.full_y, spec.full_width, spec.full_height


def _data(spec: oiio.ImageSpec) -> tuple[int, int, int, int]:
    return spec.x, spec.y, spec.width, spec.height


_RESOLUTION = re.compile(rb"\n([-+][XY]) +\d+ +([-+][XY]) +\d+\n")

_PRIMARIES = re.compile(rb"\nPRIMARIES=((?:[ \t]*[-+]?\d*\.?\d+(?:[eE][-+]?\d+)?\b){8})[ \t]*\n")

_RADIANCE = {
    b"-Y+X": 1, b"-Y-X": 2, b"+Y-X": 3, b"+Y+X": 4, b"+X-Y": 5, b"-X-Y": 6, b"-X+Y": 7, b"+X+Y": 8,
}  # fmt: skip
"""EXIF orientation for each order of pixels in a Radiance file. OpenImageIO 3.2 swaps 6 and 8."""

MAX_TEXT = 1 << 16
"""Bytes of a file that are searched for what OpenImageIO and Pillow do not tell."""


def _radiance(path: Path) -> tuple[int, tuple[str, ...]]:
    """Return the orientation of a Radiance file, and a warning about its primaries."""
    text = _start_of(path, MAX_TEXT)
    order, primaries = _RESOLUTION.search(text), _PRIMARIES.search(text)
    orientation = _RADIANCE.get(order[1] + order[2], 1) if order else 1
    if not primaries:
        return orientation, ()
    # The white of Radiance itself is off by 0.02.
    return orientation, primaries_note([float(number) for number in primaries[1].split()], 0.05)


def _check_png(path: Path, last: bytes) -> None:
    """Raise `_Unread` at a damaged chunk before the last, where libpng prints a line of its own."""
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(8)
        while head := file.read(8):
            kind = head[4:]
            if kind == last:
                return
            content = file.read(min(int.from_bytes(head[:4], "big"), size))
            needed = not kind.isalpha() or kind[:1].isupper()  # others may be damaged
            if needed and zlib.crc32(kind + content) != int.from_bytes(file.read(4), "big"):
                raise _Unread(f"its chunk {kind.decode('latin-1')} is damaged or cut")
            file.seek(0 if needed else 4, 1)


def _png_frames(path: Path) -> int:
    """Return the number of frames of an animated PNG file, 1 if it is not animated."""
    found = re.search(rb"acTL(....)", _start_of(path, MAX_TEXT).partition(b"IDAT")[0], re.S)
    return int.from_bytes(found[1], "big") if found else 1


def _pixels(path: Path, header: Header, kind: str) -> tuple[Pixels, str]:
    """Return the pixels of a file with its orientation applied, and what their alpha is."""
    try:
        if kind == "png":
            _check_png(path, b"IEND")
        with _opened(path, kind) as file:
            spec = file.spec()
            if _is_palette(spec):
                raise _Unread("its palette has other levels")
            samples = file.read_image(file.current_subimage(), 0, 0, spec.nchannels, spec.format)
            reason = file.geterror().strip()
            if samples is None or reason:  # a JPEG file that is cut has both
                raise _Unread(reason)
            pixels = _to_colors(samples.reshape(spec.height, spec.width, -1), spec)
            if kind == "openexr":
                pixels = _in_display(pixels, spec)
        orientation = header.orientation if header.upright else 1
        return oriented(pixels, orientation), header.alpha
    except _Unread as error:
        from PIL import UnidentifiedImageError

        try:
            pixels, alpha = _picture(path, header.upright)
        except UnidentifiedImageError:
            raise error from None
        if 8 * pixels.dtype.itemsize < header.depth or header.alpha == "associated":
            raise error from None
        return pixels, alpha


def _is_palette(spec: oiio.ImageSpec) -> bool:
    """Return whether a TIFF has a palette that Pillow reads.

    Programs, Pillow too, store 256 times a level; OpenImageIO divides by 257, so that white is 254.
    """
    bits = spec.getattribute("oiio:BitsPerSample")
    return bool(spec.getattribute("tiff:ColorSpace") == "palette" and bits <= 8)


def _to_colors(samples: Pixels, spec: oiio.ImageSpec) -> Pixels:
    """Convert samples (H, W, S) to grey or RGB, with alpha as the last channel, if any."""
    inverted = spec.getattribute("tiff:PhotometricInterpretation") == 0
    if samples.dtype == np.uint32:
        samples = by_strips(lambda rows: scale_to_white(rows, 2**32 - 1), samples)
    count, place = _colors_of(spec), spec.alpha_channel
    colors = samples[..., :count]
    if inverted and spec.format.size() > 1:  # OpenImageIO inverts bytes
        colors = 1 - colors if colors.dtype.kind == "f" else ~colors
    if not 0 <= place < samples.shape[2]:
        return colors
    if place == count and not inverted:
        return samples[..., : count + 1]
    return np.concatenate([colors, samples[..., place : place + 1]], axis=2)


def _in_display(pixels: Pixels, spec: oiio.ImageSpec) -> Pixels:
    """Return the display window of an EXR file, whose pixels may lie elsewhere."""
    if _display(spec) == _data(spec):
        return pixels
    window = np.zeros((spec.full_height, spec.full_width, pixels.shape[2]), pixels.dtype)
    left, top = spec.x - spec.full_x, spec.y - spec.full_y
    right, bottom = left + spec.width, top + spec.height
    target = window[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]
    source = pixels[max(-top, 0) :, max(-left, 0) :]
    target[:] = source[: target.shape[0], : target.shape[1]]
    return window


# ---------------------------------------------------------------------------------------------
#  Windows of large files
# ---------------------------------------------------------------------------------------------

MAX_BAND_VALUES = 1 << 26
"""Number of values of the largest row of tiles, or strip, that is decoded for a window. A file that
consists of one compressed strip is better decoded once."""


def has_windows(path: Path, header: Header) -> bool:
    """Return whether `read_window` can read parts of a file: a TIFF of tiles, or of small strips.

    Files that are turned, that OpenImageIO converts as a whole or from the first row on, and those
    that Pillow reads, are better decoded once.
    """
    if header.kind != "tiff" or header.orientation != 1:
        return False
    try:
        with _opened(path, header.kind) as file:
            spec = file.spec()
            values = _band_rows(spec) * (spec.tile_width or spec.width) * spec.nchannels
            name, codec = (spec.getattribute(key) for key in ("tiff:ColorSpace", "compression"))
            if values > MAX_BAND_VALUES or codec in ("jpeg", "ojpeg"):
                return False
            if name in ("YCbCr", "palette"):
                return False
            by_rows = not spec.tile_width and codec != "none"
            if by_rows and (name or spec.getattribute("oiio:BitsPerSample") != header.depth):
                return False
            _read_band(file, slice(0, _band_rows(spec)), slice(0, 1))
            return True
    except _Unread:
        return False


def _band_rows(spec: oiio.ImageSpec) -> int:
    """Return the number of rows of a TIFF file that are decoded at once."""
    if spec.tile_width:
        return int(spec.tile_height)
    if spec.getattribute("compression") == "none":  # any row can be read
        return max(1, MAX_BAND_VALUES // (64 * spec.width * spec.nchannels))
    return min(spec.getattribute("tiff:RowsPerStrip") or spec.height, spec.height)


def _read_band(file: oiio.ImageInput, rows: slice, columns: slice) -> Pixels:
    """Decode rows of a TIFF file from the first of a strip or a tile on, and cut columns out."""
    spec, number, left, right = file.spec(), file.current_subimage(), 0, file.spec().width
    top, bottom = spec.y + rows.start, spec.y + min(rows.stop, spec.height)
    if spec.tile_width:
        left = columns.start // spec.tile_width * spec.tile_width
        right = min(-(-columns.stop // spec.tile_width) * spec.tile_width, spec.width)
        place = (spec.x + left, spec.x + right, top, bottom, 0, 1, 0, spec.nchannels)
        band = file.read_tiles(number, 0, *place, spec.format)
    else:
        band = file.read_scanlines(number, 0, top, bottom, 0, 0, spec.nchannels, spec.format)
    reason = file.geterror().strip()
    if band is None or reason:
        raise _Unread(reason)
    band = band.reshape(bottom - top, right - left, spec.nchannels)
    return band[:, columns.start - left : columns.stop - left]


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
    try:
        with _opened(Path(path), "tiff") as file:
            spec, step, parts = file.spec(), _band_rows(file.spec()), []
            for top in range(rows.start // step * step, rows.stop, step):
                band = _read_band(file, slice(top, top + step), columns)
                parts.append(band[max(rows.start - top, 0) : rows.stop - top])
            return over_background(_to_colors(np.concatenate(parts), spec), _alpha_of(file))[0]
    except (_Unread, OSError) as error:
        reason = reason_of(error)
        raise ImageError(f"{path}: damaged or unreadable ({reason}); export it again") from error


# ---------------------------------------------------------------------------------------------
#  Pillow
# ---------------------------------------------------------------------------------------------

GREY_MODES = ("1", "L", "LA", "La", "I", "I;16", "I;16B", "I;16L", "F")
"""Pillow modes with one channel and optionally alpha."""

OPAQUE_BYTES, TRANSPARENT_BYTES = {1: 4, 3: 10}, {1: 12, 3: 17}
"""Bytes per pixel while a picture is decoded, by number of channels, measured with 36 to 44
megapixels: Pillow stores colours in 4 bytes, and the copy to NumPy temporarily takes 3 bytes twice.
Transparent pictures are converted to floats."""


@contextmanager
def _opened_picture(path: Path) -> Iterator[Image]:
    """Open a file with Pillow; nothing is decoded yet."""
    from PIL import Image

    if HAS_HEIF and _start_of(path, 8)[4:] == b"ftyp":
        from pillow_heif import register_heif_opener

        register_heif_opener()
    with Image.open(path) as image:
        yield image


def _picture_header(path: Path, upright: bool) -> Header:
    """Return the header of a file that Pillow reads."""
    with _opened_picture(path) as image:
        transparent = image.has_transparency_data
        channels = 1 if image.mode in GREY_MODES else 3
        # The EXIF data of a PNG file may lie behind its pixels.
        exif: Any = {} if image.format == "PNG" else image.getexif()
        orientation = exif.get(ORIENTATION, 1)
        is_turned = upright and orientation in TRANSPOSED
        width, height = image.size[::-1] if is_turned else image.size
        space = exif.get_ifd(EXIF).get(COLOR_SPACE) if exif else None
        notes = profile_note(image.info.get("icc_profile") or b"", "srgb", space)
        # The other pictures of an MPO file are a gain map or previews.
        frames = 1 if image.format == "MPO" else getattr(image, "n_frames", 1)
        notes += depth_notes(image, _start_of(path, MAX_TEXT)) + _frames_note(frames)
    needed = TRANSPARENT_BYTES[channels] if transparent else OPAQUE_BYTES[channels]
    if upright or orientation not in range(1, 9):
        orientation = 1
    return Header(
        width, height, channels, needed, orientation=orientation, notes=notes, upright=upright
    )


def _picture(path: Path, upright: bool) -> tuple[Pixels, str]:
    """Return the pixels of a file, upright or as stored, and what their alpha is."""
    from PIL import ImageOps

    with _opened_picture(path) as image:
        if upright:
            ImageOps.exif_transpose(image, in_place=True)  # copies only if the image is turned
            return picture_pixels(image)
        stored = image.info.get("original_orientation") or image.getexif().get(ORIENTATION, 1)
        pixels, alpha = picture_pixels(image)
        if image.getexif().get(ORIENTATION, 1) == 1:  # Pillow turns TIFF, and pillow-heif HEIC
            pixels = oriented(pixels, {6: 8, 8: 6}.get(stored, stored))
        return pixels, alpha


def picture_pixels(image: Image) -> tuple[Pixels, str]:
    """Return the pixels of a Pillow image by its mode, and what their alpha is.

    Parameters
    ----------
    image : PIL.Image.Image

    Returns
    -------
    pixels : ndarray, shape (H, W, C)
        Grey or RGB; with alpha as the last of 2 or 4 channels if `image.has_transparency_data`.
    alpha : {"none", "straight"}

    Raises
    ------
    ImageError
        If the mode is ambiguous or not supported.
    """
    mode, transparent = image.mode, image.has_transparency_data
    if mode == "I":
        raise ImageError("holds 32-bit integers, whose white is unknown; convert it to I;16")
    if mode == "LAB":
        raise ImageError("holds CIELab colours; convert it to RGB")
    if mode == "F" or mode.startswith("I;16"):
        pixels = np.asarray(image)[..., None]
        if transparent:
            alpha = np.where(pixels == image.info["transparency"], 0, 65535).astype(np.uint16)
            pixels = np.concatenate([pixels.astype(np.uint16), alpha], axis=2)
    elif transparent:
        kind = "LA" if mode in GREY_MODES else "RGBA"
        pixels = np.asarray(image if mode == kind else image.convert(kind))
    else:  # `convert` copies the image even if the mode is the same
        pixels = np.asarray(image if mode in ("1", "L", "RGB") else image.convert("RGB"))
        pixels = pixels if pixels.ndim == 3 else pixels[..., None]
    return pixels, "straight" if transparent else "none"


def is_picture(image: object) -> TypeGuard[Image]:
    """Return whether an image is a `PIL.Image.Image`, without importing Pillow."""
    # While another thread imports Pillow, the module is there and has no classes yet.
    kind = getattr(sys.modules.get("PIL.Image"), "Image", None)
    return kind is not None and isinstance(image, kind)

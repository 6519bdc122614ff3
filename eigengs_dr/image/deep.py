"""Files of floats and of more than 8 bits except TIFF: EXR, Radiance HDR, PNG, and netpbm files.

OpenImageIO, from the extra ``hdr``, is one wheel of 8 MB that only needs NumPy and reads EXR,
Radiance HDR and 16-bit PNG; imageio needs a download or OpenCV for these. A netpbm file (PGM, PPM
or PFM) consists of a header of four words and rows of numbers. Pillow keeps 8 bits of PPM, and
OpenImageIO 3.2 returns PFM upside down.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .header import TRANSPOSED, Header
from .pictures import exif_orientation, picture_header, png_chunks
from .pixels import ImageError
from .strips import Pixels, by_strips

if TYPE_CHECKING:
    import OpenImageIO as oiio

# ---------------------------------------------------------------------------------------------
#  OpenImageIO
# ---------------------------------------------------------------------------------------------


@contextmanager
def _opened(path: Path) -> Iterator[oiio.ImageInput]:
    """Open a file without converting its colours and alpha."""
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    config.attribute("oiio:RawColor", 1)
    file = oiio.ImageInput.open(str(path), config)
    if not file:
        raise OSError(oiio.geterror().strip())
    try:
        yield file
    finally:
        file.close()


def read_openimageio(path: Path, number: int = 0) -> Pixels:
    """Return one image of a file (H, W, C) in the type of its values.

    Raises
    ------
    OSError
        If the file cannot be decoded.
    """
    with _opened(path) as file:
        if number and not file.seek_subimage(number, 0):
            raise OSError(file.geterror().strip())
        spec = file.spec()
        pixels = file.read_image(number, 0, 0, spec.nchannels, spec.format)
        if pixels is None:
            raise OSError(file.geterror().strip())
        return np.asarray(pixels).reshape(spec.height, spec.width, spec.nchannels)


def png_header(path: Path) -> Header:
    """Return the header of a PNG file of 16-bit colour."""
    header, chunks = picture_header(path), png_chunks(path)
    # 2 bytes per value in the rows of OpenImageIO, and again in the NumPy array.
    return header._replace(
        orientation=exif_orientation(chunks.get(b"eXIf", b"")),
        bytes_per_pixel=4 * (header.channels + 1),
    )


def exr_header(path: Path) -> Header:
    """Return the header of an EXR file; reject files that are not pictures."""
    import OpenImageIO as oiio

    with _opened(path) as file:
        spec = file.spec()
        names = tuple(spec.channelnames)
        if file.seek_subimage(1, 0):
            raise ImageError("holds several parts; save one as a file of its own")
        if spec.deep:
            raise ImageError("holds deep pixels; flatten it first")
        if len(names) > 1 and names not in (("R", "G", "B"), ("R", "G", "B", "A")):
            listed = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
            raise ImageError(
                f"holds the channels {listed}; save the layer that is meant, as R, G and B, "
                "to a file of its own"
            )
        if spec.format == oiio.UINT32:
            raise ImageError("holds object IDs instead of colours; convert it to floats")
        alpha = "light" if len(names) == 4 else "none"
        channels = 1 if len(names) == 1 else 3
        needed = 4 * len(names) + 4 * len(names) * (_display(spec) != _data(spec))
        notes = _exr_notes(spec)
        return Header(
            spec.full_width, spec.full_height, channels, needed, "linear", 1, alpha, notes
        )


REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Chromaticities of red, green, blue and white, in the format of EXR and Radiance files."""


def _exr_notes(spec: oiio.ImageSpec) -> tuple[str, ...]:
    notes: tuple[str, ...] = ()
    primaries = spec.getattribute("chromaticities")
    if primaries is not None:
        notes += _primaries_note(primaries, 0.01)
    if _display(spec) != _data(spec):
        notes += ("its display window is shown, and what it lacks is black",)
    return notes


def _primaries_note(primaries: Sequence[float], tolerance: float) -> tuple[str, ...]:
    if np.abs(np.subtract(primaries, REC709)).max() <= tolerance:
        return ()
    return ("its primaries are not those of sRGB, which is ignored",)


def _display(spec: oiio.ImageSpec) -> tuple[int, int, int, int]:
    return spec.full_x, spec.full_y, spec.full_width, spec.full_height


def _data(spec: oiio.ImageSpec) -> tuple[int, int, int, int]:
    return spec.x, spec.y, spec.width, spec.height


def read_exr(path: Path) -> Pixels:
    """Return the display window of an EXR file (H, W, C) as floats."""
    with _opened(path) as file:
        spec = file.spec()
    pixels = read_openimageio(path)
    if _display(spec) == _data(spec):
        return pixels
    window = np.zeros((spec.full_height, spec.full_width, pixels.shape[2]), pixels.dtype)
    left, top = spec.x - spec.full_x, spec.y - spec.full_y
    right, bottom = left + spec.width, top + spec.height
    target = window[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]
    source = pixels[max(-top, 0) :, max(-left, 0) :]
    target[:] = source[: target.shape[0], : target.shape[1]]
    return window


_RESOLUTION = re.compile(rb"\n([-+][XY]) +\d+ +([-+][XY]) +\d+\n")

_PRIMARIES = re.compile(rb"\nPRIMARIES=((?:[ \t]*[-+]?\d*\.?\d+(?:[eE][-+]?\d+)?\b){8})[ \t]*\n")

_RADIANCE = {
    b"-Y+X": 1, b"-Y-X": 2, b"+Y-X": 3, b"+Y+X": 4, b"+X-Y": 5, b"-X-Y": 6, b"-X+Y": 7, b"+X+Y": 8,
}  # fmt: skip
"""EXIF orientation for each order of pixels in a Radiance file. OpenImageIO 3.2 swaps 6 and 8."""


def hdr_header(path: Path) -> Header:
    """Return the header of a Radiance file."""
    with path.open("rb") as file:
        text = file.read(1 << 14)
    if b"32-bit_rle_xyze" in text:
        raise ImageError("holds XYZ colours; convert it to RGB")
    with _opened(path) as opened:
        spec = opened.spec()
    order = _RESOLUTION.search(text)
    orientation = _RADIANCE.get(order[1] + order[2], 1) if order else 1
    width, height = spec.width, spec.height
    if orientation in TRANSPOSED:
        width, height = height, width
    notes: tuple[str, ...] = ()
    if found := _PRIMARIES.search(text):  # the white of Radiance itself is off by 0.02
        primaries = [float(number) for number in found[1].split()]
        notes = _primaries_note(primaries, 0.05)
    return Header(width, height, 3, 12, "linear", orientation, notes=notes)


# ---------------------------------------------------------------------------------------------
#  Portable maps
# ---------------------------------------------------------------------------------------------

_GAP = rb"(?:\s|#[^\n]*\n)+"
_NUMBER = rb"(\d{1,9})"
_PFM = re.compile(rb"(P[Ff])\s+(\d{1,9})\s+(\d{1,9})\s+(-?[0-9.eE+-]+)\s")
"""Kind (PF is RGB, Pf is grey), width, height, and a scale whose sign is the byte order."""
_PNM = re.compile(rb"(P[2356])" + _GAP + _NUMBER + _GAP + _NUMBER + _GAP + _NUMBER + rb"\s")
"""Kind (P2 and P3 are text; P3 and P6 are RGB), width, height, and the value of white."""

MAX_HEADER = 1 << 16
"""Largest size in bytes of the header of a portable map, which may contain comments."""


class _Map:
    """The header of a portable map."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            start = file.read(MAX_HEADER)
        header = _PFM.match(start) or _PNM.match(start)
        if not header:
            raise ValueError("the header of the portable map is damaged")
        self.kind, self.start = header[1], header.end()
        self.width, self.height = int(header[2]), int(header[3])
        self.channels = 3 if self.kind in (b"P3", b"P6", b"PF") else 1
        self.floats, self.text = self.kind in (b"PF", b"Pf"), self.kind in (b"P2", b"P3")
        if self.floats:
            self.dtype: np.dtype = np.dtype("<f4" if float(header[4]) < 0 else ">f4")
            return
        self.white = int(header[4])
        if not 1 <= self.white <= 65535:
            raise ValueError(f"its white is {self.white}, expected 1 to 65,535")
        self.dtype = np.dtype("u1" if self.white < 256 else ">u2")

    @property
    def bytes(self) -> int:
        return self.width * self.height * self.channels * self.dtype.itemsize


def netpbm_header(path: Path) -> Header:
    """Return the header of a PGM, PPM or PFM file."""
    header = _Map(path)
    encoding = "linear" if header.floats else "srgb"
    may_hold_several = not header.floats and not header.text
    more = may_hold_several and path.stat().st_size > header.start + 2 * header.bytes
    needed = header.channels * (8 if header.text else header.dtype.itemsize)
    notes = ("holds several images, the first is used",) if more else ()
    return Header(header.width, header.height, header.channels, needed, encoding, notes=notes)


def read_netpbm(path: Path) -> Pixels:
    """Return the pixels of a PGM, PPM or PFM file; as floats unless white is 255 or 65,535."""
    header = _Map(path)
    shape = header.height, header.width, header.channels
    with path.open("rb") as file:
        file.seek(header.start)
        content = file.read() if header.text or header.floats else file.read(header.bytes)
    if header.text:
        numbers = re.sub(rb"#[^\n]*", b"", content).split(maxsplit=int(np.prod(shape)))
        values = np.array(numbers[: int(np.prod(shape))], np.float32)
    elif len(content) != header.bytes:
        raise ValueError("its size does not match its header")
    else:
        values = np.frombuffer(content, header.dtype)
    pixels = values.reshape(shape)
    if header.floats:
        return pixels[::-1]
    if header.white in (255, 65535) and not header.text:
        return pixels
    white = np.float32(header.white)
    return by_strips(lambda rows: np.minimum(rows / white, 1), pixels)

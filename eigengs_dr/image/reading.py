"""Reading of image files: for each kind, a function for the header and one for the pixels."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from ..backend.messages import warn
from . import deep, pictures, tiff
from .formats import ADVICE, has_openimageio
from .header import Header, image_errors, oriented, over_background, transparency_note
from .pixels import EncodedImage, ImageError
from .strips import Pixels


class Reader(NamedTuple):
    """The functions that read a kind of file.

    Attributes
    ----------
    header : callable
        Returns the header of a file.
    pixels : callable
        Returns the decoded pixels (H, W, C).
    """

    header: Callable[[Path], Header]
    pixels: Callable[[Path], Pixels]


PICTURE = Reader(pictures.picture_header, pictures.read_picture)
TIFF = Reader(tiff.tiff_header, tiff.read_tiff)
PNG = Reader(deep.png_header, deep.read_openimageio)
EXR = Reader(deep.exr_header, deep.read_exr)
HDR = Reader(deep.hdr_header, deep.read_openimageio)
NETPBM = Reader(deep.netpbm_header, deep.read_netpbm)

_STARTS = {
    b"\x76\x2f\x31\x01": EXR,
    b"#?": HDR,
    b"PF": NETPBM,
    b"Pf": NETPBM,
    b"P2": NETPBM,
    b"P3": NETPBM,
    b"P5": NETPBM,
    b"P6": NETPBM,
    b"II*\0": TIFF,
    b"MM\0*": TIFF,
    b"II+\0": TIFF,
    b"MM\0+": TIFF,
    b"\x89PNG\r\n\x1a\n": PNG,
}

_DEEP_PNG = (2, 4, 6)
"""Colour types of PNG for which Pillow keeps only 8 bits: RGB, grey with alpha, RGBA."""


def reader_of(path: Path) -> Reader:
    """Return the reader of a file by its first bytes.

    Raises
    ------
    OSError
        If the file cannot be opened.
    """
    with path.open("rb") as file:
        start = file.read(32)
    reader = next((reader for first, reader in _STARTS.items() if start.startswith(first)), PICTURE)
    deep_png = start[24:25] == b"\x10" and start[25] in _DEEP_PNG
    if reader is PNG and not deep_png:
        return PICTURE
    return PICTURE if reader is NETPBM and not start[2:3].isspace() else reader


def read_header(path: Path) -> Header:
    """Return the header of an image file; no pixel is decoded.

    Raises
    ------
    ImageError
        If the header cannot be read or is not supported; see `load_image`.
    """
    with image_errors(path):
        reader = reader_of(path)
        if reader is PNG and not has_openimageio():
            header = PICTURE.header(path)
            return header._replace(
                notes=(f"keeps 8 of its 16 bits; to keep all {ADVICE}", *header.notes)
            )
        return reader.header(path)


def decode(path: Path, header: Header, keep_grey: bool, name: str = "") -> EncodedImage:
    """Return the pixels of a file, grey or RGB in the type of the file, and their encoding.

    Warnings refer to the file as `name`, by default its path. For warnings and errors see
    `load_image`.
    """
    with image_errors(path):
        reader = reader_of(path)
        if reader is EXR and header.channels == 1 and not keep_grey:
            raise ImageError(
                "holds one channel, not R, G and B; read it as data (keep_grey=True, "
                "--space data), or export it as RGB"
            )
        if reader is PNG and not has_openimageio():
            reader = PICTURE
        pixels = reader.pixels(path)
    for note in header.notes:
        warn(f"{name or path}: {note}")
    pixels, transparent = over_background(oriented(pixels, header.orientation), header.alpha)
    if transparent:
        warn(f"{name or path}: {transparency_note(header.alpha)}")
    return EncodedImage(pixels, header.encoding)

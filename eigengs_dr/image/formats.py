"""Which library reads and writes a file: Pillow, tifffile for TIFF of more bits, OpenImageIO.

Pillow keeps 8 bits of TIFF files and reads no floats. OpenImageIO, from the extra ``hdr``, is one
wheel of 8 MB that needs NumPy alone and does EXR, Radiance HDR and PNG of 16 bits; imageio does it
by a download or by OpenCV. A portable float map has a header of three lines, then rows of float32
from bottom to top; OpenImageIO 3.2 returns them upside down.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..backend.feedback import warn
from .pixels import EncodedImage, ImageError, peak_of, reason_of, scale
from .strips import Pixels, by_strips

if TYPE_CHECKING:
    from PIL.Image import Image

BITS: dict[str, tuple[int, ...]] = {
    ".png": (8, 16),
    ".jpg": (8,),
    ".jpeg": (8,),
    ".webp": (8,),
    ".tif": (8, 16, 32),
    ".tiff": (8, 16, 32),
    ".bmp": (8,),
    ".ppm": (8,),
    ".exr": (32, 16),
    ".hdr": (32,),
    ".pfm": (32,),
}
"""Suffixes of files that are written, with the bits of a value; the first number is the default. 32
are floats, and so are 16 in an EXR file. An HDR file stores 8 bits of a value and an exponent."""

SUFFIXES = tuple(BITS)

PICTURE_SUFFIXES = tuple(suffix for suffix, bits in BITS.items() if 8 in bits)
"""Suffixes of files of 8 bits, which Pillow writes."""

TIFF_SUFFIXES = (".tif", ".tiff")

LOSSY = (".jpg", ".jpeg", ".webp")

MAX_PIXELS = 1 << 29
"""Largest number of pixels of a file; a damaged header may claim more than memory holds."""

ADVICE = "needs OpenImageIO; type: pip install 'eigengs-dr[hdr]'"

MAX_HALF = 65_504.0
"""Largest finite float of 16 bits."""

_STARTS = {
    b"\x76\x2f\x31\x01": "exr",
    b"#?": "hdr",
    b"PF": "pfm",
    b"Pf": "pfm",
    b"II*\0": "tiff",
    b"MM\0*": "tiff",
    b"II+\0": "tiff",
    b"MM\0+": "tiff",
    b"\x89PNG\r\n\x1a\n": "png",
}

_DEEP_PNG = (2, 4, 6)
"""Colour types of PNG of which Pillow keeps 8 bits only: RGB, grey with alpha, RGBA."""

_DEEP_TIFF = ("u2", "f2", "f4", "f8")
"""Types of values of a TIFF file that tifffile reads here."""


def kind_of(path: Path) -> str | None:
    """Return "exr", "hdr", "pfm", "tiff" or "png" by the first bytes of a file.

    Returns None for files that Pillow reads without loss; a file of the kind "tiff" may be one.

    Raises
    ------
    OSError
        If the file cannot be opened.
    """
    with path.open("rb") as file:
        start = file.read(32)
    kind = next((kind for first, kind in _STARTS.items() if start.startswith(first)), None)
    if kind == "png" and not (start[24:25] == b"\x10" and start[25] in _DEEP_PNG):
        return None
    if kind == "pfm" and not start[2:3].isspace():
        return None
    return kind


def decode_file(path: Path, keep_grey: bool) -> EncodedImage:
    """Return the pixels of a file, grey or RGB in its own dtype, and what they are.

    For warnings and errors see `load_image`.
    """
    with image_errors(path):
        kind = kind_of(path)
        if kind == "png" and not has_openimageio():
            warn(f"{path}: keeps 8 of its 16 bits; to keep all {ADVICE}")
            kind = None
        pixels = _read_deep(path, kind)
    if pixels is None:
        with open_picture(path) as file:
            frames = getattr(file, "n_frames", 1)
            pixels, transparent = picture_pixels(file)
        if transparent:
            warn(f"{path}: transparent pixels are shown over white")
        if frames > 1:
            warn(f"{path}: holds {frames} frames, the first is used")
        return EncodedImage(pixels, "srgb")
    encoding, channels = "linear" if pixels.dtype.kind == "f" else "srgb", pixels.shape[2]
    if kind == "exr" and channels == 1 and not keep_grey:
        raise ImageError(
            f"{path}: holds one channel, not R, G and B; read it as data (keep_grey=True, "
            "--space data), or export it as RGB"
        )
    if channels in (1, 3):
        return EncodedImage(pixels, encoding)
    if (pixels[..., -1] < peak_of(pixels.dtype)).any():
        warn(f"{path}: transparent pixels are shown over {'black' if kind == 'exr' else 'white'}")
        if kind != "exr":  # whose colours are multiplied by alpha
            return EncodedImage(over_white(pixels), encoding)
    return EncodedImage(pixels[..., :-1], encoding)


def _read_deep(path: Path, kind: str | None) -> Pixels | None:
    """Return pixels (H, W, C) of uint16 or floats, or None if Pillow reads them without loss."""
    if kind == "tiff":
        return _read_tiff(path)
    if kind == "pfm":
        return _read_pfm(path)
    return None if kind is None else _read_openimageio(path, kind)


def write_file(path: Path, pixels: Pixels, bits: int) -> None:
    """Write pixels (H, W, C): float32, uint16 for PNG and TIFF files of 16 bits, or uint8.

    Raises
    ------
    ImportError, ValueError, OSError
        If a package is missing, or the file cannot be written.
    """
    suffix = path.suffix.lower()
    grey = pixels.shape[2] == 1
    flat = pixels[..., 0] if grey else pixels
    if bits == 8 or (suffix == ".png" and grey):
        from PIL import Image

        options: dict[str, Any] = {"quality": 95} if suffix in LOSSY else {}
        Image.fromarray(flat).save(path, **options)
    elif suffix in TIFF_SUFFIXES:
        import tifffile

        kind = "minisblack" if grey else "rgb"
        tifffile.imwrite(path, flat, photometric=kind, compression="zlib")
    elif suffix == ".pfm":
        header = f"{'Pf' if grey else 'PF'}\n{pixels.shape[1]} {pixels.shape[0]}\n-1.0\n"
        path.write_bytes(header.encode() + pixels[::-1].astype("<f4").tobytes())
    else:
        _write_openimageio(path, pixels, bits)


# ---------------------------------------------------------------------------------------------
#  Pillow
# ---------------------------------------------------------------------------------------------


@contextmanager
def open_picture(path: Path, most: int | None = None) -> Iterator[Image]:
    """Open an image file with Pillow, turned as its EXIF header says; errors as `load_image`.

    With `most`, the sides have at most so many pixels, which the header says before anything is
    decoded, and Pillow's own limit, of the whole process, does not count.
    """
    from PIL import Image, ImageOps  # 0.05 s

    with image_errors(path), Image.open(path) if most is None else open_header(path) as file:
        if most is not None and max(file.size) > most:
            width, height = file.size
            raise ImageError(f"{path}: {width}x{height} pixels; sides go from 1 to {most:,}")
        ImageOps.exif_transpose(file, in_place=True)  # a copy only if it turns the image
        yield file


def open_header(path: Path) -> Any:
    """Return what `PIL.Image.open` returns, of any size: nothing is decoded yet.

    Pillow's limit on pixels is a variable of the whole process, which threads share.

    Raises
    ------
    PIL.UnidentifiedImageError
        If Pillow does not know the file.
    """
    from PIL import Image, UnidentifiedImageError

    Image.init()
    file = path.open("rb")
    prefix = file.read(16)
    for name in Image.ID:
        factory, accepts = Image.OPEN[name]
        known = accepts is None or accepts(prefix)
        if known and not isinstance(known, str):
            file.seek(0)
            with suppress(SyntaxError, IndexError, TypeError, struct.error):  # as Image.open
                return factory(file, str(path))
    file.close()
    raise UnidentifiedImageError(f"cannot identify image file {path}")


@contextmanager
def image_errors(path: Path) -> Iterator[None]:
    """Turn the errors of a block that reads a file into errors of `load_image`."""
    from PIL import Image, UnidentifiedImageError

    try:
        if path.stat().st_size == 0:
            raise ImageError(f"{path}: the file is empty (0 bytes); copy or export it again")
        yield
    except ImageError:
        raise
    except Exception as error:  # on damaged files decoders raise many types
        reason = reason_of(error)
        known = {
            FileNotFoundError: "no such file; check the path",
            IsADirectoryError: "is a folder; name an image file in it",
            PermissionError: "may not be read; check its permissions",
            UnidentifiedImageError: "not an image that Pillow knows; save it as PNG or JPEG",
            Image.DecompressionBombError: (
                f"has more than {2 * (Image.MAX_IMAGE_PIXELS or 0):,} pixels; scale it down first, "
                "or fit it in blocks"
            ),
            ImportError: ADVICE,
        }
        damaged = f"damaged or unsupported ({reason}); export it again"
        said = next((text for kind, text in known.items() if isinstance(error, kind)), damaged)
        raise ImageError(f"{path}: {said}") from error


def picture_pixels(image: Image) -> tuple[Pixels, bool]:
    """Return the pixels of a Pillow image, and whether some of them are transparent."""
    if image.mode == "I":  # 16-bit grey of PGM files comes as 32-bit integers
        return np.asarray(image) / 65535, False
    if image.mode == "F" or image.mode.startswith("I;16"):
        return np.asarray(image), False
    if not image.has_transparency_data:
        # `convert` copies the image even if the mode stays.
        return np.asarray(image if image.mode in ("1", "L", "RGB") else image.convert("RGB")), False
    pixels = np.asarray(image.convert("RGBA"))
    return over_white(pixels), bool(pixels[..., 3].min() < 255)


def over_white(pixels: Pixels) -> NDArray[np.float32]:
    """Show colours with alpha, the last channel, over white."""
    peak = peak_of(pixels.dtype)

    def show(rows: Pixels) -> NDArray[np.float32]:
        rows = scale(rows, peak)
        return 1 - rows[..., -1:] * (1 - rows[..., :-1])

    return by_strips(show, pixels, channels=pixels.shape[2] - 1)


# ---------------------------------------------------------------------------------------------
#  TIFF and portable float maps
# ---------------------------------------------------------------------------------------------


def _read_tiff(path: Path) -> Pixels | None:
    """Read the first image of a TIFF file, if it holds more than 8 bits."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        page = file.pages[0]
        known = page.dtype is not None and page.dtype.str[1:] in _DEEP_TIFF
        black_is_zero = page.photometric in (1, 2)  # grey or RGB, no palette
        if not known or not black_is_zero or page.samplesperpixel > 4:
            return None
        _check_size(path, page.imagewidth, page.imagelength)
        pixels = page.asarray()
        turned = page.tags["Orientation"].value if "Orientation" in page.tags else 1
        if pixels.ndim == 3 and page.planarconfig == 2:
            pixels = np.moveaxis(pixels, 0, 2)
    pixels = pixels if pixels.ndim == 3 else pixels[..., None]
    # The orientation is that of EXIF.
    if turned in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if turned in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return pixels[:, ::-1] if turned in (2, 3, 6, 7) else pixels


_HEADER = re.compile(rb"(P[Ff])\s+(\d{1,9})\s+(\d{1,9})\s+(-?[0-9.eE+-]+)\s")
"""Kind (PF is RGB, Pf is grey), width, height, and a scale that is negative for little endian."""


def _read_pfm(path: Path) -> Pixels:
    """Read a portable float map."""
    content = path.read_bytes()
    header = _HEADER.match(content)
    if not header:
        raise ValueError("no header of a float map")
    width, height, channels = int(header[2]), int(header[3]), 3 if header[1] == b"PF" else 1
    if len(content) - header.end() != 4 * width * height * channels:
        raise ValueError("its size is not that of its header")
    order = "<f4" if float(header[4]) < 0 else ">f4"
    pixels = np.frombuffer(content, order, offset=header.end())
    return pixels.reshape(height, width, channels)[::-1]


def _check_size(path: Path, width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise ImageError(f"{path}: has more than {MAX_PIXELS:,} pixels; scale it down first")


# ---------------------------------------------------------------------------------------------
#  OpenImageIO: EXR, Radiance HDR, and PNG of 16 bits
# ---------------------------------------------------------------------------------------------


def has_openimageio() -> bool:
    """Return whether OpenImageIO is installed."""
    return find_spec("OpenImageIO") is not None


def _read_openimageio(path: Path, kind: str) -> Pixels:
    """Read a file of one image; alpha is not multiplied into the colours, except in EXR."""
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    file = oiio.ImageInput.open(str(path), config)
    if not file:
        raise OSError(oiio.geterror().strip())
    spec = file.spec()
    _check_size(path, spec.width, spec.height)
    if kind == "exr":
        names = tuple(spec.channelnames)
        if file.seek_subimage(1, 0):
            raise ImageError(f"{path}: holds several parts; save one as a file of its own")
        if spec.deep:
            raise ImageError(f"{path}: holds deep pixels; flatten it first")
        if len(names) > 1 and names not in (("R", "G", "B"), ("R", "G", "B", "A")):
            shown = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
            raise ImageError(
                f"{path}: holds the channels {shown}; save the layer that is meant, as R, G and B, "
                "to a file of its own"
            )
    file.seek_subimage(0, 0)
    values = oiio.UINT16 if kind == "png" else oiio.FLOAT
    pixels = file.read_image(0, 0, 0, spec.nchannels, values)
    if pixels is None:
        raise OSError(file.geterror().strip())
    return np.asarray(pixels)


def _write_openimageio(path: Path, pixels: Pixels, bits: int) -> None:
    """Write an EXR or HDR file, or a PNG of 16 bits; 16-bit floats are clamped to +-65,504."""
    import OpenImageIO as oiio

    suffix = path.suffix.lower()
    if suffix == ".hdr":  # it has three channels
        pixels = np.broadcast_to(pixels, (*pixels.shape[:2], 3))
    kind = "uint16" if pixels.dtype == np.uint16 else ("half" if bits == 16 else "float")
    if kind == "half":
        pixels = np.clip(pixels, -MAX_HALF, MAX_HALF)
    image = oiio.ImageBuf(np.ascontiguousarray(pixels))
    image.set_write_format(kind)
    image.specmod().channelnames = ("R", "G", "B") if pixels.shape[2] == 3 else ("Y",)
    if suffix == ".exr":
        image.specmod().attribute("compression", "zip")
    if not image.write(str(path)):
        raise OSError(image.geterror().strip())

"""Files that Pillow reads and writes."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..pixels import ImageError
from ..strips import map_threads, strips

if TYPE_CHECKING:
    from PIL.Image import Image

SAVE_OPTIONS: dict[str, dict[str, Any]] = {
    ".png": {},
    ".jpg": {"quality": 95},
    ".jpeg": {"quality": 95},
    ".webp": {"quality": 95},
    ".tif": {},
    ".tiff": {},
    ".bmp": {},
    ".ppm": {},
}
"""Suffixes of files that Pillow writes, with the options that it receives."""


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
    except FileNotFoundError:
        raise ImageError(f"{path}: no such file; check the path") from None
    except IsADirectoryError:
        raise ImageError(f"{path}: is a folder; name an image file in it") from None
    except PermissionError:
        raise ImageError(f"{path}: may not be read; check its permissions") from None
    except UnidentifiedImageError:
        raise ImageError(
            f"{path}: not an image that Pillow knows; save it as PNG or JPEG"
        ) from None
    except Image.DecompressionBombError:
        limit = f"{2 * (Image.MAX_IMAGE_PIXELS or 0):,}"
        raise ImageError(
            f"{path}: has more than {limit} pixels; scale it down first, or fit it in blocks"
        ) from None
    except Exception as error:  # on damaged files Pillow's decoders raise many types
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ImageError(f"{path}: damaged or unsupported ({reason}); export it again") from error


def picture_pixels(image: Image) -> tuple[NDArray[Any], bool]:
    """Return the pixels of a Pillow image, and whether some of them are transparent."""
    if image.mode == "I":  # 16-bit grey of PGM files comes as 32-bit integers
        return np.asarray(image) / 65535, False
    if image.mode == "F" or image.mode.startswith("I;16"):
        return np.asarray(image), False
    if not image.has_transparency_data:
        # `convert` copies the image even if the mode stays.
        return np.asarray(image if image.mode in ("1", "L", "RGB") else image.convert("RGB")), False
    pixels = np.asarray(image.convert("RGBA"))
    shown = np.empty((*pixels.shape[:2], 3), np.float32)

    def show_over_white(rows: slice) -> None:
        part = pixels[rows].astype(np.float32) / 255
        color, alpha = part[..., :3], part[..., 3:]
        shown[rows] = 1 - alpha * (1 - color)

    map_threads(show_over_white, strips(*shown.shape[:2]))
    return shown, bool(pixels[..., 3].min() < 255)

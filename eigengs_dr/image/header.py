"""What the header of an image file says, before any of its pixels is decoded."""

from __future__ import annotations

import stat
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..storage.memory import check_content
from .color import to_coded
from .formats import ADVICE
from .pixels import ImageError, peak_of, reason_of, scale
from .strips import Pixels, by_strips

TURNED = range(5, 9)
"""EXIF orientations that swap width and height."""

ORIENTATION = 0x0112
"""EXIF tag, and tag of TIFF, of the orientation."""


class Header(NamedTuple):
    """What the header of a file says of its pixels.

    Attributes
    ----------
    width, height : int
        Pixels, as the image is shown.
    channels : int
        1 for grey, 3 for colours; alpha does not count.
    bytes_per_pixel : int
        Memory while the file is decoded.
    encoding : {"srgb", "linear"}
    orientation : int
        EXIF orientation of the decoded pixels.
    alpha : {"none", "straight", "associated", "light"}
        Whether the last decoded channel is alpha. Colours may be multiplied by it already, as
        sRGB ("associated") or as light, which is then shown over black ("light").
    notes : tuple of str
        Warnings.
    """

    width: int
    height: int
    channels: int
    bytes_per_pixel: int
    encoding: str = "srgb"
    orientation: int = 1
    alpha: str = "none"
    notes: tuple[str, ...] = ()

    def check_memory(self, path: Path, as_floats: bool = True) -> None:
        """Refuse a file whose pixels take too much memory; see `check_content`.

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


@contextmanager
def image_errors(path: Path) -> Iterator[None]:
    """Turn the errors of a block that reads a file into errors of `load_image`, with its name."""
    from PIL import UnidentifiedImageError

    try:
        state = path.stat()
        if stat.S_ISCHR(state.st_mode) or stat.S_ISBLK(state.st_mode):
            raise ImageError("is a device; name an image file")
        if state.st_size == 0 and stat.S_ISREG(state.st_mode):
            raise ImageError("the file is empty (0 bytes); copy or export it again")
        yield
    except ImageError as error:
        text = str(error)
        raise ImageError(text if text.startswith(f"{path}: ") else f"{path}: {text}") from None
    except Exception as error:  # on damaged files decoders raise many types
        reason = reason_of(error)
        known = {
            FileNotFoundError: "no such file; check the path",
            IsADirectoryError: "is a folder; name an image file in it",
            PermissionError: "may not be read; check its permissions",
            UnidentifiedImageError: "not an image that Pillow knows; save it as PNG or JPEG",
            ImportError: ADVICE,
        }
        damaged = f"damaged or unsupported ({reason}); export it again"
        text = next((text for kind, text in known.items() if isinstance(error, kind)), damaged)
        raise ImageError(f"{path}: {text}") from error


def oriented(pixels: Pixels, orientation: int) -> Pixels:
    """Turn decoded pixels (H, W, C) as an EXIF orientation says; a view."""
    if orientation in TURNED:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return pixels[:, ::-1] if orientation in (2, 3, 6, 7) else pixels


def over_background(pixels: Pixels, alpha: str) -> tuple[Pixels, bool]:
    """Return colours without alpha, and whether some of them were transparent.

    Parameters
    ----------
    pixels : ndarray, shape (H, W, C)
    alpha : str
        See `Header`.
    """
    if alpha == "none":
        return pixels, False
    peak = peak_of(pixels.dtype)
    if not (pixels[..., -1] < peak).any():
        return pixels[..., :-1], False
    if alpha == "light":
        return pixels[..., :-1], True

    def show(rows: Pixels) -> NDArray[np.float32]:
        rows = scale(rows, peak)
        if alpha == "associated":
            return rows[..., :-1] + (1 - rows[..., -1:])
        return 1 - rows[..., -1:] * (1 - rows[..., :-1])

    return by_strips(show, pixels, channels=pixels.shape[2] - 1), True


def transparency_note(alpha: str) -> str:
    """Return the warning for transparent pixels."""
    return f"transparent pixels are shown over {'black' if alpha == 'light' else 'white'}"


def frames_note(frames: int, name: str = "frames") -> tuple[str, ...]:
    """Return the warning for a file of several images."""
    return (f"holds {frames} {name}, the first is used",) if frames > 1 else ()


PATCHES = (0, 64, 128, 192, 255)
"""Levels of red, green and blue by which a colour profile is compared with sRGB."""

SAME_COLOR = 4
"""Largest difference of levels of 255 between profiles that count as equal."""


@lru_cache(64)  # images of one camera share a profile
def profile_note(profile: bytes, encoding: str) -> tuple[str, ...]:
    """Return a warning if an ICC profile gives other colours than sRGB, or than light.

    Parameters
    ----------
    profile : bytes
        Empty for none.
    encoding : {"srgb", "linear"}
        What the pixels count as.
    """
    if not profile:
        return ()
    from PIL import Image, ImageCms

    try:
        opened = ImageCms.ImageCmsProfile(BytesIO(profile))
        name = ImageCms.getProfileDescription(opened).strip()
        mode = {"GRAY": "L", "CMYK": "CMYK"}.get(opened.profile.xcolor_space.strip(), "RGB")
        if mode != "CMYK":
            grid = np.stack(np.meshgrid(PATCHES, PATCHES, PATCHES), axis=-1)
            levels = grid.reshape(5, 25, 3).astype(np.uint8)
            levels = levels[..., 0] if mode == "L" else levels
            shown = ImageCms.profileToProfile(
                Image.fromarray(levels), opened, ImageCms.createProfile("sRGB"), outputMode="RGB"
            )
            codes = levels / 255 if encoding == "srgb" else to_coded(levels / 255)
            codes = codes[..., None] if mode == "L" else codes
            if np.abs(np.asarray(shown) - 255 * codes).max() <= SAME_COLOR:
                return ()
    except Exception:  # Little CMS raises several types on damaged profiles, or is missing
        return ("its colour profile cannot be read, and is ignored",)
    return (f"its colour profile {name!r} is not sRGB, and is ignored",)

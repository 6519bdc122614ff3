"""Headers of image files, which are read before any pixel is decoded."""

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
from .formats import ADVICE, HAS_HEIF, HEIF_SUFFIXES
from .pixels import ImageError, peak_of, reason_of, scale
from .strips import Pixels, by_strips

TRANSPOSED = range(5, 9)
"""EXIF orientations that swap width and height."""

ORIENTATION = 0x0112
"""Tag of the orientation in EXIF and TIFF."""


class Header(NamedTuple):
    """The header of an image file: the properties of its pixels.

    Attributes
    ----------
    width, height : int
        Size in pixels, after the orientation is applied.
    channels : int
        1 for grey, 3 for colours; alpha does not count.
    bytes_per_pixel : int
        Memory that decoding takes, in bytes per pixel.
    encoding : {"srgb", "linear"}
    orientation : int
        EXIF orientation of the decoded pixels.
    alpha : {"none", "straight", "associated", "light"}
        Whether the last decoded channel is alpha. Colours may already be multiplied by it, as sRGB
        ("associated") or as light, which is then shown over black ("light").
    notes : tuple of str
        Warnings about the file.
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


@contextmanager
def image_errors(path: Path) -> Iterator[None]:
    """Convert errors of a block that reads a file to `ImageError`s that name the file."""
    from PIL import UnidentifiedImageError

    try:
        state = path.stat()
        if stat.S_ISCHR(state.st_mode) or stat.S_ISBLK(state.st_mode):
            raise ImageError("is a device; give an image file")
        if state.st_size == 0 and stat.S_ISREG(state.st_mode):
            raise ImageError("the file is empty (0 bytes); copy or export it again")
        yield
    except ImageError as error:
        text = str(error)
        raise ImageError(text if text.startswith(f"{path}: ") else f"{path}: {text}") from None
    except Exception as error:  # on damaged files decoders raise many types
        reason = reason_of(error)
        unknown = "not an image that Pillow knows; save it as PNG or JPEG"
        if path.suffix.lower() in HEIF_SUFFIXES and not HAS_HEIF:
            unknown = "needs pillow-heif; type: pip install pillow-heif"
        messages = {
            FileNotFoundError: "no such file; check the path",
            IsADirectoryError: "is a folder; give an image file in it",
            PermissionError: "permission denied; check its permissions",
            UnidentifiedImageError: unknown,
            ImportError: ADVICE,
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


def over_background(pixels: Pixels, alpha: str) -> tuple[Pixels, bool]:
    """Return colours without alpha, and whether some pixels were transparent.

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

    def blend(rows: Pixels) -> NDArray[np.float32]:
        rows = scale(rows, peak)
        if alpha == "associated":
            return rows[..., :-1] + (1 - rows[..., -1:])
        return 1 - rows[..., -1:] * (1 - rows[..., :-1])

    return by_strips(blend, pixels, channels=pixels.shape[2] - 1), True


def transparency_note(alpha: str) -> str:
    """Return the warning about transparent pixels."""
    return f"transparent pixels are shown over {'black' if alpha == 'light' else 'white'}"


def frames_note(frames: int, name: str = "frames") -> tuple[str, ...]:
    """Return the warning about a file with several images."""
    return (f"holds {frames} {name}, the first is used",) if frames > 1 else ()


PROFILE_LEVELS = (0, 64, 128, 192, 255)
"""Levels of red, green and blue at which a colour profile is compared with sRGB."""

PROFILE_TOLERANCE = 4
"""Largest difference, in levels of 255, between colour profiles that count as equal."""


@lru_cache(64)  # images of one camera share a profile
def profile_note(profile: bytes, encoding: str) -> tuple[str, ...]:
    """Return a warning if an ICC profile differs from sRGB, or from linear light.

    Parameters
    ----------
    profile : bytes
        Empty if there is no profile.
    encoding : {"srgb", "linear"}
        The assumed encoding of the pixels.
    """
    if not profile:
        return ()
    from PIL import Image, ImageCms

    try:
        opened = ImageCms.ImageCmsProfile(BytesIO(profile))
        name = ImageCms.getProfileDescription(opened).strip()
        mode = {"GRAY": "L", "CMYK": "CMYK"}.get(opened.profile.xcolor_space.strip(), "RGB")
        if mode != "CMYK":
            grid = np.stack(np.meshgrid(*[PROFILE_LEVELS] * 3), axis=-1)
            levels = grid.reshape(5, 25, 3).astype(np.uint8)
            levels = levels[..., 0] if mode == "L" else levels
            converted = ImageCms.profileToProfile(
                Image.fromarray(levels), opened, ImageCms.createProfile("sRGB"), outputMode="RGB"
            )
            codes = levels / 255 if encoding == "srgb" else to_coded(levels / 255)
            codes = codes[..., None] if mode == "L" else codes
            if np.abs(np.asarray(converted) - 255 * codes).max() <= PROFILE_TOLERANCE:
                return ()
    except Exception:  # Little CMS raises several types on damaged profiles, or is missing
        return ("its colour profile cannot be read, and is ignored",)
    return (f"its colour profile {name!r} is not sRGB, and is ignored",)

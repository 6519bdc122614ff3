"""Warnings about properties of image files that are not applied: colours that are not sRGB, depths.

A colour profile counts as sRGB if it converts a grid of colours as sRGB does. A series of images
has one warning for each note.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np

from ..backend.messages import warn
from .color import to_coded

if TYPE_CHECKING:
    import OpenImageIO as oiio
    from PIL.Image import Image

Notes = tuple[str, ...]
"""Warnings; empty if there is nothing to say."""

NotedImages = dict[str, dict[str, None]]
"""The names of the images that have a note, in order, by the note."""

_noted: ContextVar[NotedImages | None] = ContextVar("noted", default=None)
"""The notes of the open series, if there is one."""


def tell(name: str, note: str) -> None:
    """Warn about an image: at once, or at the end of the series to which it belongs.

    Without a name, the note is not about an image.
    """
    noted = _noted.get()
    if noted is None:
        warn(f"{name}: {note}" if name else note)
    else:
        noted.setdefault(note, {})[name] = None


@contextmanager
def kept_notes() -> Iterator[NotedImages]:
    """Keep the notes of a block, instead of warning."""
    noted: NotedImages = {}
    token = _noted.set(noted)
    try:
        yield noted
    finally:
        _noted.reset(token)


@contextmanager
def kept_warnings() -> Iterator[NotedImages]:
    """Keep the notes of a block of a worker, and after it its other warnings, without names."""
    with kept_notes() as noted, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        yield noted
    noted |= {str(w.message): {"": None} for w in caught if issubclass(w.category, UserWarning)}


def tell_all(noted: NotedImages) -> None:
    """Tell notes that were kept, such as those of a thread or a worker."""
    for note, names in noted.items():
        for name in names:
            tell(name, note)


@contextmanager
def series() -> Iterator[None]:
    """Warn once for each note of the images of a block: name the first, count the others."""
    noted: NotedImages = {}
    try:
        with kept_notes() as noted:
            yield
    finally:
        if _noted.get() is not None:  # a longer series goes on
            tell_all(noted)
        else:
            for note, (first, *others) in noted.items():
                tell(first, note + (f"; so for {len(others)} more" if others else ""))


PROFILE_LEVELS = (0, 64, 128, 192, 255)
"""Levels of red, green and blue at which a colour profile is compared with sRGB."""

PROFILE_TOLERANCE = 4
"""Largest difference, in levels of 255, between colour profiles that count as equal."""


EXIF_SPACES = {2: "Adobe RGB", 65535: "Adobe RGB or another space"}
"""Values of the tag ColorSpace that are not sRGB; the DCF option R03, Adobe RGB, has the second."""


@lru_cache(64)  # images of one camera share a profile
def profile_note(profile: bytes, encoding: str, exif_space: object = None) -> Notes:
    """Return a warning if an ICC profile differs from sRGB, or from linear light.

    Parameters
    ----------
    profile : bytes
        Empty if there is no profile.
    encoding : {"srgb", "linear"}
        The assumed encoding of the pixels.
    exif_space : int, optional
        The tag ColorSpace of EXIF, which counts if there is no profile.
    """
    if not profile:
        name = EXIF_SPACES.get(exif_space) if encoding == "srgb" else None  # type: ignore[call-overload]
        return (f"its colours are {name} by EXIF, not sRGB, which is ignored",) if name else ()
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


REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Chromaticities of red, green, blue and white, in the format of EXR and Radiance files."""


def primaries_note(primaries: Sequence[float], tolerance: float) -> Notes:
    """Return a warning if chromaticities are not those of sRGB."""
    if np.abs(np.subtract(primaries, REC709)).max() <= tolerance:
        return ()
    return ("its primaries are not those of sRGB, which is ignored",)


def transparency_note(alpha: str) -> Notes:
    """Return the warning about transparent pixels by what alpha is, see `Header` of `read`."""
    if alpha == "none":
        return ()
    return (f"transparent pixels are shown over {'black' if alpha == 'light' else 'white'}",)


GAIN_MAP: Notes = ("its gain map, for light above white, is left out",)

ABOVE_WHITE = "its light above white is kept, but displays and textures clamp it"

TRANSFERS = {8: "linear light", 14: "Rec. 2020", 15: "Rec. 2020", 16: "PQ", 18: "HLG"}
"""Transfer functions of ITU-T H.273 that differ much from sRGB."""

PRIMARIES = {9: "Rec. 2020", 11: "P3", 12: "P3"}
"""Primaries of ITU-T H.273 with wider gamuts."""


def video_note(primaries: int, transfer: int) -> Notes:
    """Return a warning about codes of ITU-T H.273 that are not those of sRGB."""
    names = {PRIMARIES.get(primaries, ""), TRANSFERS.get(transfer, "")} - {""}
    if not names:
        return ()
    return (f"its colours are {' and '.join(sorted(names))}, not sRGB, which is ignored",)


def png_notes(spec: oiio.ImageSpec) -> Notes:
    """Return warnings about the colours of a PNG file, by the chunk of highest priority."""
    code, name = spec.getattribute("CICP"), spec.getattribute("oiio:ColorSpace")
    if code is not None:
        return video_note(*code[:2])
    gamma = 1.0 if name == "lin_rec709_scene" else spec.getattribute("oiio:Gamma")
    if gamma is None or spec.getattribute("ICCProfile") is not None or abs(gamma / 2.2 - 1) < 0.05:
        return ()
    return (f"its gamma of {1 / gamma:g} is not that of sRGB, and is ignored",)


_PIXI = re.compile(rb"pixi\0\0\0\0.(.)", re.S)
_NCLX = re.compile(rb"colrnclx(..)(..)", re.S)
_SIZ = re.compile(rb"\xff\x4f\xff\x51.{38}(.)", re.S)


def depth_notes(image: Image, start: bytes) -> Notes:
    """Return warnings about what Pillow ignores in AVIF, HEIF and JPEG 2000 files, by their start.

    The other kinds that it reads have no notes.
    """
    kind, notes, bits = image.format, Notes(), 8
    if kind == "HEIF":
        bits, color = image.info.get("bit_depth", 8), image.info.get("nclx_profile") or {}
        names = ("color_primaries", "transfer_characteristics")
        notes = video_note(*(color.get(name, 1) for name in names))
    elif kind == "AVIF":
        bits = max((match[1][0] for match in _PIXI.finditer(start)), default=8)
        if match := _NCLX.search(start):
            notes = video_note(*(int.from_bytes(code, "big") for code in match.groups()))
    elif kind == "JPEG2000":
        match = _SIZ.search(start)
        bits = (match[1][0] & 127) + 1 if match else 8
        grey = match is not None and match[0][-3:-1] == b"\0\1"
        bits = 8 if grey and bits <= 16 else bits  # Pillow keeps all bits of these
    return (*notes, f"keeps 8 of its {bits} bits") if bits > 8 else notes

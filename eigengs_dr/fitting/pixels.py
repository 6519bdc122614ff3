"""The pixels of a fit: the image of the user after its checks, and its weights."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from ..backend.types import ArrayLike, PathLike, Values
from ..image.color import rendered_as
from ..image.io import check_data, check_image, read_image
from ..image.pixels import MAX_PIXEL, MIN_PIXEL, EncodedImage, ImageError

PixelsOrPath: TypeAlias = ArrayLike | PathLike | EncodedImage
"""An image: array_like pixels, such as a ``mitsuba.Bitmap``; pixels that know their encoding; or
the path or the address of a file."""

Image = NDArray[np.float32]

WHITE = 1.001
"""Largest sRGB code of light that counts as bounded by white; renderings exceed 1 by rounding."""

BRIGHT = {"ycbcr": "log", "rgb": "log", "linear": "radiance"}
"""Space of a fit of light above 1, by the requested space: textures clamp sums in the others."""


def read_pixels(
    image: PixelsOrPath, space: str, weight: Image | None = None, encoding: str | None = None
) -> tuple[Image, str]:
    """Check an image, and convert it to display values (sRGB).

    Parameters
    ----------
    image : array_like
        See `eigengs_dr.fit`.
    space : str
    weight : ndarray, shape (H, W) or (H, W, C), optional
        From `check_weight`. Pixels without any weight get the value of the nearest pixel with
        weight.
    encoding : {"srgb", "linear"}, optional

    Returns
    -------
    pixels : ndarray of float32, shape (H, W, 3) or (H, W, 1)
        sRGB, above 1 for light above 1; or the data. They may be the image itself.
    space : str
        The given space, or another if the image is light above 1, see `BRIGHT`.

    Raises
    ------
    ImageError
        If the image is unusable.
    """
    data = rendered_as(space) is None
    encoded = read_image(image, data, encoding)
    if weight is not None:
        encoded = encoded._replace(pixels=_filled(encoded, weight))
    if data:
        return _read_data(encoded, space), space
    pixels = check_image(encoded, copy=False)
    if encoded.encoding == "linear" and pixels.max() > WHITE:
        space = BRIGHT.get(space, space)
    return pixels, space


def _read_data(image: EncodedImage, space: str) -> Image:
    """Check an image of data, one to three channels, or of normals, shape (H, W, 3)."""
    pixels = check_data(image, copy=False)
    if space == "normal":
        check_normals(pixels)
    return pixels


def check_normals(pixels: Image) -> None:
    """Raise ImageError unless pixels (H, W, C) are codes of normals."""
    if pixels.shape[2] != 3:
        raise ImageError(
            f"image: shape {pixels.shape}; a normal map has three channels; use space 'data'"
        )
    if pixels.min() < MIN_PIXEL or pixels.max() > MAX_PIXEL:
        raise ImageError(
            f"image: normals run from {pixels.min():g} to {pixels.max():g}, not 0 to 1; pass "
            "(n + 1) / 2"
        )


def check_channels(weight: Image | None, channels: int) -> None:
    """Raise ValueError unless weights (H, W) or (H, W, C) fit the number of channels."""
    if weight is not None and weight.ndim == 3 and weight.shape[2] not in (1, channels):
        raise ValueError(
            f"weight has {weight.shape[2]} channels, but the fit has {channels}; give (H, W), or "
            f"(H, W, {channels})"
        )


def _filled(image: EncodedImage, weight: Image) -> Values:
    """Return pixels in which those without weight have the value of the nearest others."""
    pixels = np.asarray(image.pixels)
    if pixels.ndim not in (2, 3) or pixels.shape[:2] != weight.shape[:2]:
        height, width = weight.shape[:2]
        raise ValueError(
            f"weight is for {width}x{height} pixels, but the image has shape {pixels.shape}"
        )
    ignored = ~(weight.reshape(*weight.shape[:2], -1) > 0).any(axis=2)
    if ignored.any():
        nearest = distance_transform_edt(ignored, return_distances=False, return_indices=True)
        pixels = pixels[tuple(nearest)]
    return pixels

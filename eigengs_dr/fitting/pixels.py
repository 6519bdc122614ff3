"""The pixels of a fit: the image of the user after its checks, and its weights."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt

from ..backend.types import PathLike, Values
from ..image.io import check_data, check_image, read_image
from ..image.pixels import EncodedImage
from ..image.space import Space

PixelsOrPath: TypeAlias = ArrayLike | PathLike | EncodedImage
"""An image: array_like pixels, such as a ``mitsuba.Bitmap``; pixels that know their encoding; or
the path or the address of a file."""

Image = NDArray[np.float32]

WHITE = 1.001
"""Largest sRGB code of light that counts as bounded by white; renderings exceed 1 by rounding."""


def read_pixels(
    image: PixelsOrPath, space: Space, weight: Image | None = None, encoding: str | None = None
) -> tuple[Image, Space]:
    """Check an image, and convert it to display values (sRGB).

    Parameters
    ----------
    image : array_like
        See `eigengs_dr.fit`.
    space : Space
    weight : ndarray, shape (H, W) or (H, W, C), optional
        From `check_weight`. Pixels without any weight get the value of the nearest pixel with
        weight.
    encoding : {"srgb", "linear"}, optional

    Returns
    -------
    pixels : ndarray of float32, shape (H, W, 3) or (H, W, 1)
        sRGB, above 1 for light above 1; or the data. They may be the image itself.
    space : Space
        The given space, or another if the image is light above 1, see `Space.above_white`.

    Raises
    ------
    ImageError
        If the image is unusable.
    """
    encoded = read_image(image, not space.is_color, encoding)
    if weight is not None:
        encoded = encoded._replace(pixels=_filled(encoded, weight))
    if not space.is_color:
        pixels = check_data(encoded, copy=False)
        space.check(pixels)
        return pixels, space
    pixels = check_image(encoded, copy=False)
    bright = encoded.encoding == "linear" and pixels.max() > WHITE
    return pixels, space.above_white if bright else space


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

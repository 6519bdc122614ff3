"""The pixels of a fit: sRGB, whatever the image holds, or data in [-1, 1]."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..gaussian.gaussians import Gaussians
from ..image.color import rendered_as
from ..image.io import read_image
from ..image.pixels import MAX_PIXEL, MIN_PIXEL, ImageError, check_data, check_image, encoding_of
from .options import FitOptions

WHITE = 1.001
"""Largest sRGB code of light that counts as bounded by white; renderings exceed 1 by rounding."""


BRIGHT = {"ycbcr": "log", "rgb": "log", "linear": "radiance"}
"""Space of a fit of light above 1 for the space asked for: textures clamp sums in the others."""


def read_pixels(image: Any, options: FitOptions) -> tuple[NDArray[np.float32], FitOptions]:
    """Check an image, and convert it to what `eigengs_dr.fitting` works on.

    Parameters
    ----------
    image : array_like
        See `eigengs_dr.fit`.
    options : FitOptions

    Returns
    -------
    pixels : ndarray of float32, shape (H, W, 3) or (H, W, 1)
        sRGB, above 1 for light above 1; or the data. They may be the image itself.
    options : FitOptions
        With another space if the image is light above 1, see `BRIGHT`.

    Raises
    ------
    ImageError
        If the image is unusable.
    """
    if rendered_as(options.space) is None:
        return read_data(image, options.space), options
    image = read_image(image, encoding=options.encoding)
    encoding = encoding_of(image, options.encoding) or "srgb"
    pixels = check_image(image, copy=False, encoding=encoding)
    if encoding == "linear" and pixels.max() > WHITE:
        options = replace(options, space=BRIGHT.get(options.space, options.space))
    return pixels, options


def read_data(image: Any, space: str) -> NDArray[np.float32]:
    """Check an image of data, shape (H, W, 1) or (H, W, 3), or of normals, shape (H, W, 3).

    Raises
    ------
    ImageError
        If the image is unusable, or no normal map.
    """
    pixels = check_data(read_image(image, keep_grey=True), copy=False)
    if space != "normal":
        return pixels
    if pixels.shape[2] != 3:
        raise ImageError(
            f"image: shape {pixels.shape}; a normal map has three channels; use space 'data'"
        )
    if pixels.min() < MIN_PIXEL or pixels.max() > MAX_PIXEL:
        raise ImageError(
            f"image: normals run from {pixels.min():g} to {pixels.max():g}, not 0 to 1; pass "
            "(n + 1) / 2"
        )
    return pixels


def unit_of(pixels: NDArray[np.float32], space: str) -> float:
    """Return the unit in which data are fitted: steps of colours are made for values up to 1."""
    largest = float(np.abs(pixels).max()) if space == "data" else 0.0
    return largest if largest > MAX_PIXEL else 1.0


def in_unit(gaussians: Gaussians, unit: float) -> Gaussians:
    """Multiply the colours and the background of a set."""
    if unit == 1:
        return gaussians
    return replace(gaussians, color=gaussians.color * unit, background=gaussians.background * unit)

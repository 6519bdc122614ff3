"""The target of a fit for cameras: the smoothest texture that looks like the image to them.

A smooth texture needs few Gaussians. `eigengs_dr.scene.back_projection` makes it; here it is chosen
by what the cameras see, and its errors are weighed by how much of a pixel a texel fills.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from ..fitting.target import dark_weight
from ..image.color import to_coded
from ..plugins.cone import PIXEL
from .back_projection import back_project, extrapolate
from .visibility import Visibility

BLURS = (0.4, 0.25, 0.15, 0.1)
"""Standard deviations in pixels of the blur of the back-projection. `smoothest_target` takes the
first one that leaves `MARGIN`."""

MARGIN = 6.0
"""Decibels between the PSNR of the target and the PSNR that its Gaussians must reach."""

EVEN = 2.0
"""Standard deviation in texels of the blur of the weights, because rays hit texels unevenly."""

Image = NDArray[np.float32]


def seen_by(texels: Image, rows: Any, space: str) -> NDArray[Any]:
    """Return what the pixels of a camera see of a texture.

    Parameters
    ----------
    texels : ndarray of float32, shape (H, W, C)
        Linear light or data; clamped to [0, 1].
    rows : scipy.sparse array, shape (n, H * W)
        One of `Visibility.pixel_to_texel`.
    space : {"linear", "data"}
        Whether means of light are coded as sRGB.

    Returns
    -------
    ndarray, shape (n, 1, C)
    """
    looks = rows @ texels.clip(0, 1).reshape(-1, texels.shape[2])
    return (to_coded(looks) if space == "linear" else looks)[:, None]


def smoothest_target(values: Image, found: Visibility, is_close: Callable[[Image], bool]) -> Image:
    """Find the target of the fit: the smoothest texture that is close enough, or else the image.

    Parameters
    ----------
    values : ndarray of float32, shape (H, W, C)
    found : Visibility
    is_close : callable
        Whether a texture looks like the image to all cameras.

    Returns
    -------
    ndarray of float32, shape (H, W, C)
    """
    whole = extrapolate(values, found.seen)
    for share in BLURS:
        target = back_project(whole, found, share / PIXEL)
        if is_close(target):
            return target
    return whole


def error_weights(found: Visibility, target: Image, space: str) -> Image:
    """Return factors of the errors: the square root of each texel's share of the pixels.

    Parameters
    ----------
    found : Visibility
    target : ndarray of float32, shape (H, W, C)
    space : {"linear", "data"}
        In linear light dark texels weigh more, see `eigengs_dr.fitting.target.dark_weight`.

    Returns
    -------
    ndarray of float32, shape (H, W, C)
    """
    share = gaussian_filter(found.pixels, EVEN) * found.seen
    weight = np.sqrt(share / share.max())[..., None]
    light = dark_weight(target) if space == "linear" else np.ones_like(target)
    return (weight * light).astype(np.float32)

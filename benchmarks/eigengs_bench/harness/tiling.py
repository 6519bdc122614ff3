"""Penny-round tiles: splats that show where an image is smooth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eigengs_bench.harness.timing import Image
from eigengs_dr.color import RGB_TO_YCBCR

LUMA = RGB_TO_YCBCR[0] / RGB_TO_YCBCR[0].sum()
"""Weights of R, G and B in the luma of ITU-R BT.601, where 1 is white."""

SIGMA = 4.0
"""Standard deviation in pixels of the blur that takes tiles away and keeps what is no tile: it
leaves 0.2 % of a wave of 7 pixels, the distance of 5,000 splats on 512x512, and 93 % of one of 64.
"""

LEVELS = 2.0
"""Where an image differs by more from its own blur, in 8-bit levels, it has content that hides
tiles, and errors beside edges are none. Rounding to 8 bits stays below."""

REACH = 2 * SIGMA
"""Pixels around such content that do not count either: the blur carries its errors there."""


def tiling(picture: Image, image: Image) -> float:
    """Measure fine errors in the smooth regions of an image, in 8-bit levels.

    With ``r`` the luma of ``picture - image`` and G a Gaussian blur of `SIGMA` pixels, it is

        ``255 sqrt(mean over S of (r - G r)^2)``

    where S is `smooth_regions`, which depend on the image alone: the figure is linear in the error.
    Slow errors, such as a wrong shade, pass the blur and do not count.

    Parameters
    ----------
    picture, image : ndarray of float, shape (H, W, 3)
        What was fitted and what to; RGB, 1 is white.

    Returns
    -------
    float
        0 for equal pictures; an error of some levels is seen. NaN where nothing is smooth.

    Raises
    ------
    ValueError
        If the shapes differ.

    Examples
    --------
    >>> image = np.full((32, 32, 3), 0.5)
    >>> round(tiling(image + 0.01 * (np.indices((32, 32)).sum(0) % 2)[..., None], image), 1)
    1.3
    """
    if picture.shape != image.shape:
        raise ValueError(f"tiling: the shapes {picture.shape} and {image.shape} differ")
    region = smooth_regions(image)
    if not region.any():
        return float("nan")
    fine = _fine((picture - image) @ LUMA)
    return 255 * float(np.sqrt(np.mean(np.square(fine[region]))))


def smooth_regions(image: Image) -> NDArray[np.bool_]:
    """Find the pixels whose surroundings, `REACH` pixels far, are within `LEVELS` of their blur.

    Returns
    -------
    ndarray of bool, shape (H, W)
    """
    from scipy.ndimage import maximum_filter

    detail = 255 * np.abs(_fine(image @ LUMA))
    return np.asarray(maximum_filter(detail, 2 * round(REACH) + 1, mode="nearest") <= LEVELS)


def _fine(plane: NDArray[np.floating]) -> NDArray[np.float64]:
    """What a blur does not keep."""
    from scipy.ndimage import gaussian_filter

    plane = plane.astype(np.float64)
    return plane - gaussian_filter(plane, SIGMA)

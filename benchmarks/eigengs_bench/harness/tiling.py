"""Penny-round tiles: Gaussians that show where an image is smooth."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter

from eigengs_bench.harness.timing import Image
from eigengs_dr.image.color import RGB_TO_YCBCR

# Weights of R, G and B in the luma of ITU-R BT.601, where 1 is white.
LUMA = RGB_TO_YCBCR[0] / RGB_TO_YCBCR[0].sum()
# Standard deviation in pixels of the blur that takes tiles away: it leaves 0.2 % of a wave of 7
# pixels, the distance of 5,000 Gaussians on 512x512, and 93 % of one of 64.
SIGMA = 4.0
# Where an image differs by more from its own blur, in 8-bit levels, it has content that hides
# tiles, and errors beside edges are none. Rounding to 8 bits stays below.
LEVELS = 2.0


def tiling(picture: Image, image: Image) -> float:
    """Measure fine errors in the smooth regions of an image, in 8-bit levels.

    With ``r`` the luma of ``picture - image``, G a Gaussian blur of `SIGMA` pixels and S the
    `smooth_regions`, it is ``255 sqrt(mean over S of (r - G r)^2)``: linear in the error, blind to
    slow errors such as a wrong shade, 0 for equal pictures, NaN where nothing is smooth.

    Examples
    --------
    >>> image = np.full((32, 32, 3), 0.5)
    >>> round(tiling(image + 0.01 * (np.indices((32, 32)).sum(0) % 2)[..., None], image), 1)
    1.3
    """
    region = smooth_regions(image)
    if not region.any():
        return float("nan")
    return 255 * float(np.sqrt(np.mean(np.square(_fine((picture - image) @ LUMA)[region]))))


def smooth_regions(image: Image) -> NDArray[np.bool_]:
    """Find the pixels, shape (H, W), around which nothing differs by `LEVELS` from its blur."""
    detail = 255 * np.abs(_fine(image @ LUMA))
    reach = 2 * round(2 * SIGMA) + 1  # the blur carries errors of content as far
    return np.asarray(maximum_filter(detail, reach, mode="nearest") <= LEVELS)


def _fine(plane: NDArray[np.floating]) -> NDArray[np.float64]:
    plane = plane.astype(np.float64)
    return plane - gaussian_filter(plane, SIGMA)

"""The form of the images of a family: one size, one colour space, and a row for each channel."""

from __future__ import annotations

from operator import index
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .color import RGB_TO_YCBCR, YCBCR_OFFSET

BASIS_SPACES = ("ycbcr", "rgb")
"""Colour spaces of a family."""


def check_size(size: Any) -> tuple[int, int]:
    """Return a size, (width, height) in pixels, as two integers.

    Parameters
    ----------
    size : (int, int)

    Raises
    ------
    ValueError
        If `size` is not a pair of integers, or a side is not positive.
    """
    try:
        width, height = map(index, size)
    except (TypeError, ValueError):
        raise ValueError(f"size is {size!r}; expected (width, height) in whole pixels") from None
    if min(width, height) < 1:
        raise ValueError(f"size is {width}x{height}; both sides must be at least 1 pixel")
    return width, height


def to_planes(image: NDArray[np.float32], space: str) -> NDArray[np.float32]:
    """Convert an RGB image to a colour space and separate its channels.

    Parameters
    ----------
    image : ndarray of float32, shape (H, W, 3)
    space : {"ycbcr", "rgb"}

    Returns
    -------
    ndarray of float32, shape (3, H * W)
        Each channel row by row; ``"ycbcr"`` is `eigengs_dr.image.color.rgb_to_ycbcr` in float32.
    """
    planes = np.ascontiguousarray(image.reshape(-1, 3).T)
    if space == "rgb":
        return planes
    # No matrix product: the threads of BLAS would compete with the decoding threads for cores.
    result = np.empty_like(planes)
    for row, weights, offset in zip(
        result, RGB_TO_YCBCR.astype(np.float32), YCBCR_OFFSET.astype(np.float32), strict=True
    ):
        np.multiply(planes[0], weights[0], out=row)
        row += weights[1] * planes[1]
        row += weights[2] * planes[2]
        row += offset
    return result

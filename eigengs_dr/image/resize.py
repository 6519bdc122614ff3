"""Antialiased bicubic resampling of images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def resample(image: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Resize an image to any aspect ratio.

    Parameters
    ----------
    image : ndarray of float32, shape (H, W, C)
        Any number of channels and any finite values.
    width, height : int
        Size of the result in pixels, at least 1.

    Returns
    -------
    ndarray of float32, shape (height, width, C)
        Values are not clamped and may overshoot at edges by a few percent. A copy if the size does
        not change.

    Raises
    ------
    ValueError
        If a side of the result is not positive.
    """
    return _resized(image, width, height, (0, 0, image.shape[1], image.shape[0]))


def center_crop(image: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Crop an image to its largest centred part with the aspect ratio of the result, and resize it.

    Parameters, result and errors as for `resample`. The part may begin inside a pixel, so that the
    centre of the image is preserved exactly. Filters also use the pixels around the part.
    """
    rows, columns = image.shape[:2]
    scale = min(columns / max(width, 1), rows / max(height, 1))
    # Rounding must not move the box out of the image.
    left, top = max(0, (columns - scale * width) / 2), max(0, (rows - scale * height) / 2)
    return _resized(image, width, height, (left, top, columns - left, rows - top))


def _resized(
    image: NDArray[np.float32], width: int, height: int, box: tuple[float, float, float, float]
) -> NDArray[np.float32]:
    """Resample the part of an image inside a box (left, top, right, bottom) in pixels."""
    from PIL import Image

    if min(width, height) < 1:
        raise ValueError(f"size is {width}x{height}; both sides must be at least 1 pixel")
    if image.shape[:2] == (height, width):
        return image.copy()
    result = np.empty((height, width, image.shape[2]), np.float32)
    for channel in range(image.shape[2]):
        plane = Image.fromarray(np.ascontiguousarray(image[..., channel]))
        resized = plane.resize((width, height), Image.Resampling.BICUBIC, box)
        result[..., channel] = np.asarray(resized)
    return result

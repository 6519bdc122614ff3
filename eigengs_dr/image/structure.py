"""Structural similarity of two images: sums of SSIM and of its parts, strip by strip."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .blur import blur, gaussian_taps
from .strips import map_threads, strips

WINDOW = 11
"""Side of the Gaussian window of SSIM and MS-SSIM, in pixels."""

SIGMA = 1.5
"""Standard deviation of that window, in pixels."""

Convert = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Changes the values of some rows of an image, in double precision."""


def window_radius(sides: tuple[int, ...]) -> int:
    """Return the radius of the window: that of `WINDOW`, or the largest that fits the image."""
    return min(WINDOW // 2, (min(sides) - 1) // 2)


def similarity(
    x: NDArray[Any], y: NDArray[Any], convert: Convert
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean SSIM and mean contrast-structure term per channel of two (H, W, 3) images.

    The images are converted and compared strip by strip: large ones need no copy in double
    precision. Only pixels whose window lies inside the image count.
    """
    height, width = x.shape[:2]
    radius = window_radius((height, width))
    taps = gaussian_taps(SIGMA, radius / SIGMA)
    rows, columns = height - 2 * radius, width - 2 * radius

    def sums(strip: slice) -> NDArray[np.float64]:
        inside = slice(strip.start, strip.stop + 2 * radius)
        p, q = (convert(image[inside].astype(np.float64)) for image in (x, y))
        return np.array([_similarity_sums(p[..., k], q[..., k], taps) for k in range(3)])

    whole, structure = (sum(map_threads(sums, strips(rows, width))) / (rows * columns)).T
    return whole, structure


def _similarity_sums(
    x: NDArray[np.float64], y: NDArray[np.float64], taps: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the sums of SSIM and of its contrast-structure term over two planes (H, W)."""
    c1, c2 = 0.01**2, 0.03**2
    x, y = np.ascontiguousarray(x), np.ascontiguousarray(y)
    mean_x, mean_y = blur(x, taps), blur(y, taps)
    product, squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    covariance, variances = blur(x * y, taps) - product, blur(x * x + y * y, taps) - squares
    structure = (2 * covariance + c2) / (variances + c2)
    luminance = (2 * product + c1) / (squares + c1)
    return float((luminance * structure).sum()), float(structure.sum())


def halve(image: NDArray[Any]) -> NDArray[np.float64]:
    """Return the means of the 2x2 blocks of an image (H, W, 3); drop an odd last row or column."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    result = np.empty((height, width, 3))

    def fill(rows: slice) -> None:
        part = image[2 * rows.start : 2 * rows.stop, : 2 * width].astype(np.float64)
        np.mean(part.reshape(-1, 2, width, 2, 3), axis=(1, 3), out=result[rows])

    map_threads(fill, strips(height, 2 * width))
    return result

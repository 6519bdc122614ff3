"""The sum of Gaussians in float64, and what YCbCr stands for."""

import numpy as np

FROM_YCBCR = np.array([[255, 0, 349.53], [255, -85.796, -178.04], [255, 441.774, 0]]) / 219
BLACK = np.array([16, 128, 128]) / 255
"""YCbCr of BT.601: Y from 16 to 235, Cb and Cr from 16 to 240."""


def render_exact(
    mean: np.ndarray,
    factor: np.ndarray,
    color: np.ndarray,
    background: np.ndarray,
    width: int,
    height: int,
    cutoff: float = np.inf,
) -> np.ndarray:
    """Sum all Gaussians at all pixels in float64, without tiles, by default without a cutoff.

    Cost: ``N * width * height`` exponentials.

    Parameters
    ----------
    mean : ndarray, shape (N, 2)
        In pixels.
    factor : ndarray, shape (N, 3)
        a, b, c of ``F = [[a, b], [0, c]]``, in 1 / pixels.
    color : ndarray, shape (N, C)
    background : ndarray, shape (C,)
    width, height : int
    cutoff : float, optional
        Standard deviations.

    Returns
    -------
    ndarray of float64, shape (height, width, C)
    """
    x = np.arange(width) + 0.5
    y = (np.arange(height) + 0.5)[:, None]
    image = np.tile(np.asarray(background, np.float64), (height, width, 1))
    for (mx, my), (a, b, c), value in zip(
        mean.astype(np.float64), factor.astype(np.float64), color.astype(np.float64), strict=True
    ):
        q = (a * (x - mx) + b * (y - my)) ** 2 + (c * (y - my)) ** 2
        image += np.where(q <= cutoff**2, np.exp(-0.5 * q), 0.0)[..., None] * value
    return image

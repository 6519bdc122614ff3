"""Similarity of two images: PSNR in RGB and YCbCr, SSIM and MS-SSIM."""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .color import RGB_TO_YCBCR, rgb_to_ycbcr
from .io import to_8bit
from .strips import map_threads, strips

WINDOW = 11
"""Side of the Gaussian window of SSIM and MS-SSIM, in pixels."""

SIGMA = 1.5
"""Standard deviation of that window, in pixels."""

MAX_PSNR = 100.0
"""Upper bound of reported PSNRs, in dB: above it, only rounding errors differ."""

SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of MS-SSIM from the finest scale to the coarsest, Wang et al. 2003, section 3.2."""


def psnr(a: ArrayLike, b: ArrayLike, space: str = "rgb") -> float:
    """Compute the peak signal-to-noise ratio of two images, in decibels.

    ``"rgb"`` compares 8-bit images: both are clamped to [0, 1] and rounded, and the peak is 255.
    ``"ycbcr"`` compares studio-range YCbCr / 255 with peak 1 and neither clamps nor rounds, like
    the official EigenGS code. The range of Y spans 219/255 of the peak. Therefore ``"ycbcr"`` gives
    higher numbers than ``"rgb"``: 4.94 dB more for white noise, 6.09 dB more for an error in grey.
    ``"data"`` compares the channels with peak 1 and neither clamps nor rounds.

    Parameters
    ----------
    a, b : array_like of float, shape (H, W, 3) or (H, W, 1)
        RGB or grey, 1 is white. Their order does not matter.
    space : {"rgb", "ycbcr", "data"}
        Space in which the mean squared error over all pixels and channels is computed.

    Returns
    -------
    float
        ``10 log10(peak^2 / mse)``; infinite for equal images, NaN if a pixel is NaN. Computed in
        double precision, strip by strip: the function makes no copy of an image.

    Raises
    ------
    ValueError
        If the shapes differ or are not as above, or the space is unknown.

    Examples
    --------
    >>> round(psnr(np.zeros((4, 4, 3)), np.full((4, 4, 3), 0.1), space="ycbcr"), 2)
    26.09
    """
    if space not in ("rgb", "ycbcr", "data"):
        raise ValueError(f"space {space!r} is unknown; use 'rgb', 'ycbcr' or 'data'")
    x, y = _pair(a, b)

    def squares(rows: slice) -> float:
        return _squared_error(x[rows].astype(np.float64), y[rows].astype(np.float64), space)

    return psnr_from_mse(sum(map_threads(squares, strips(*x.shape[:2]))) / x.size)


def _squared_error(a: NDArray[np.float64], b: NDArray[np.float64], space: str) -> float:
    """Return the sum of the squared differences of two images in a space; overwrite both."""
    if space == "rgb":
        for image in (a, b):
            to_8bit(image, out=image)
    np.subtract(a, b, out=a)
    if space == "ycbcr":
        # |M d|^2 = trace(M d d^T M^T): the sums of the products of R, G and B are enough.
        difference = a.reshape(-1, 3)
        products = difference.T @ difference
        return float(np.trace(RGB_TO_YCBCR @ products @ RGB_TO_YCBCR.T))
    np.square(a, out=a)
    return float(a.sum()) / (255**2 if space == "rgb" else 1)


def float_space(color: str) -> str:
    """Return the space in which psnr_ycbcr compares sets of the space `color`.

    Sets in the space "data" have no YCbCr, so their channels are compared directly.
    """
    return "data" if color == "data" else "ycbcr"


def psnr_from_mse(mse: float) -> float:
    """Return ``10 log10(1 / mse)``, the PSNR of a mean squared error whose peak is 1; inf for 0."""
    return math.inf if mse == 0 else -10 * math.log10(mse)


def ssim(a: ArrayLike, b: ArrayLike) -> float:
    """Compute the structural similarity of two images, with the settings of Wang et al. 2004.

    Images are clamped to [0, 1]. The window is Gaussian, 11 pixels wide with sigma 1.5. The mean is
    taken over the channels and over the pixels whose window lies inside the image. If a side is
    shorter than 11 pixels, the image is mirrored at its borders and border pixels count too.

    Parameters
    ----------
    a, b : array_like of float, shape (H, W, 3) or (H, W, 1)
        RGB or grey, 1 is white. Their order does not matter.

    Returns
    -------
    float
        At most 1; 1 for equal images.

    Raises
    ------
    ValueError
        If the shapes differ or are not as above.

    References
    ----------
    Z. Wang, A. Bovik, H. Sheikh, E. Simoncelli: Image quality assessment: from error visibility to
    structural similarity. IEEE Transactions on Image Processing 13(4), 2004. Computed by
    `skimage.metrics.structural_similarity`.
    """
    from skimage.metrics import structural_similarity  # the import takes 0.3 s

    x, y = (image.astype(np.float64) for image in _pair(a, b))
    similarity = structural_similarity(
        np.clip(x, 0, 1),
        np.clip(y, 0, 1),
        win_size=_window_size(x.shape[:2]),
        data_range=1,
        channel_axis=2,
        gaussian_weights=True,
        sigma=SIGMA,
        use_sample_covariance=False,
    )
    return float(similarity)


def ms_ssim(a: ArrayLike, b: ArrayLike, space: str = "ycbcr") -> float:
    r"""Compute the multi-scale structural similarity of two images (Wang et al. 2003).

    The result is the mean over the channels of

    .. math:: \prod_{j<J} c_j^{w_j} \; s_J^{w_J}

    with the mean contrast-structure term :math:`c_j` of scale j and the mean SSIM :math:`s_J` of
    the coarsest scale; negative means count as 0. Channels are not clamped, and the peak is 1. The
    window is Gaussian, 11 pixels wide with sigma 1.5, and stays inside the image. Each scale halves
    the previous one by 2x2 means. The official EigenGS code calls this number SSIM: `ms_ssim` of
    pytorch-msssim with ``data_range=1``. Halving drops an odd last row or column; pytorch-msssim
    pads it with zeros.

    The smaller side of the coarsest scale has at least 11 pixels, so an image needs 176 pixels for
    all five scales. With fewer scales, their exponents are scaled up to the same sum. If the
    smaller side is below 11 pixels, the window shrinks to the largest odd size that fits.

    Parameters
    ----------
    a, b : array_like of float, shape (H, W, 3) or (H, W, 1)
        RGB or grey, 1 is white. Their order does not matter.
    space : {"ycbcr", "data"}
        Channels to compare: Y, Cb and Cr, or the channels of the images.

    Returns
    -------
    float
        In [0, 1]; 1 for equal images.

    Raises
    ------
    ValueError
        If the shapes differ or are not as above, or the space is unknown.

    References
    ----------
    Z. Wang, E. Simoncelli, A. Bovik: Multiscale structural similarity for image quality assessment.
    Asilomar Conference on Signals, Systems and Computers, 2003. The variant is that of
    https://github.com/VainF/pytorch-msssim.
    """
    if space not in ("ycbcr", "data"):
        raise ValueError(f"space {space!r} is unknown; use 'ycbcr' or 'data'")
    pair = [image.astype(np.float64) for image in _pair(a, b)]
    planes = [rgb_to_ycbcr(image) if space == "ycbcr" else image for image in pair]
    x, y = (np.moveaxis(image, 2, 0) for image in planes)
    side = min(x.shape[1:])
    scales = max(1, sum(side >> j >= WINDOW for j in range(len(SCALE_WEIGHTS))))
    weights = np.array(SCALE_WEIGHTS[:scales]) * (sum(SCALE_WEIGHTS) / sum(SCALE_WEIGHTS[:scales]))

    product = np.ones(3)
    for weight in weights[:-1]:
        product *= np.maximum(_similarity(x, y)[1], 0) ** weight
        x, y = _halved(x), _halved(y)
    product *= np.maximum(_similarity(x, y)[0], 0) ** weights[-1]
    return float(product.mean())


def _pair(a: ArrayLike, b: ArrayLike) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return both images as RGB of one shape (H, W, 3) without a copy; grey is replicated."""
    x, y = np.asarray(a), np.asarray(b)
    if x.shape != y.shape:
        raise ValueError(f"images have shapes {x.shape} and {y.shape}; crop or scale one of them")
    if x.ndim != 3 or x.shape[2] not in (1, 3) or x.size == 0:
        raise ValueError(
            f"images have shape {x.shape}; expected (H, W, 3) or (H, W, 1) with pixels in it"
        )
    shape = (*x.shape[:2], 3)
    return np.broadcast_to(x, shape), np.broadcast_to(y, shape)


def _window_size(sides: tuple[int, ...]) -> int:
    """Return the side of the window: `WINDOW`, or the largest odd number that fits the image."""
    return min(WINDOW, (min(sides) - 1) // 2 * 2 + 1)


def _similarity(
    x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return mean SSIM and mean contrast-structure term per channel of two (3, H, W) images."""
    c1, c2 = 0.01**2, 0.03**2
    mean_x, mean_y, xx, yy, xy = _windowed_means(np.stack([x, y, x * x, y * y, x * y]))
    covariance = xy - mean_x * mean_y
    variances = (xx - mean_x**2) + (yy - mean_y**2)
    structure = (2 * covariance + c2) / (variances + c2)
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    return (luminance * structure).mean(axis=(1, 2)), structure.mean(axis=(1, 2))


def _windowed_means(maps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Gaussian means over the last two axes, for pixels whose window lies inside."""
    from scipy.ndimage import correlate1d  # the import takes 0.2 s

    height, width = maps.shape[-2:]
    margin = _window_size((height, width)) // 2
    window = np.exp(-0.5 * (np.arange(-margin, margin + 1) / SIGMA) ** 2)
    window /= window.sum()
    for axis in (-2, -1):
        maps = correlate1d(maps, window, axis=axis)
    return maps[..., margin : height - margin, margin : width - margin]


def _halved(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the means of the 2x2 blocks of a (3, H, W) image; drop an odd last row or column."""
    height, width = image.shape[1] // 2, image.shape[2] // 2
    blocks = image[:, : 2 * height, : 2 * width].reshape(3, height, 2, width, 2)
    return blocks.mean(axis=(2, 4))

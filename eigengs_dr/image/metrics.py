"""Similarity of two images: PSNR in RGB and YCbCr, SSIM and MS-SSIM, strip by strip.

PSNR is computed by NumPy: 64x64 pixels take 0.1 ms, where Dr.Jit needs 70 ms to start, and the copy
to its memory takes as long as the sum. SSIM is that of `eigengs_dr.image.structure`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, overload

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from ..backend.entry_points import checks_types
from ..backend.types import ArrayLike, Doubles, DrJitArray, Float, Singles
from .color import RGB_TO_YCBCR, rgb_to_ycbcr, to_linear, to_pu21
from .io import read_image, to_8bit
from .pixels import Pixels, check_weight, is_tensor, map_threads, peak_of, strips

MAX_PSNR = 100.0
"""Upper bound of reported PSNRs, in dB: above it, differences are rounding errors."""

SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of MS-SSIM from the finest scale to the coarsest, Wang et al. 2003, section 3.2."""


@checks_types
def psnr(a: ArrayLike, b: ArrayLike, space: str = "rgb", weight: ArrayLike | None = None) -> float:
    """Compute the peak signal-to-noise ratio of two images, in decibels.

    ``"rgb"`` compares 8-bit images: both are clamped to [0, 1] and rounded, and the peak is 255.
    ``"ycbcr"`` compares studio-range YCbCr / 255 with peak 1 and neither clamps nor rounds, like
    the official EigenGS code. The range of Y spans 219/255 of the peak. Therefore ``"ycbcr"`` gives
    higher numbers than ``"rgb"``: 4.94 dB more for white noise, 6.09 dB more for an error in grey.
    ``"data"`` compares the channels with peak 1 and neither clamps nor rounds.
    ``"pu21"`` compares light, also above 1, perceptually: it decodes sRGB and compares codes of
    `eigengs_dr.image.color.to_pu21`, with the code of white, 1, as the peak. Light above 100 counts
    as 100.

    Parameters
    ----------
    a, b : array_like, shape (H, W, 3) or (H, W, 1)
        RGB or grey: floats with 1 as white, or bool, uint8, uint16 (scaled to
        [0, 1]). Their order does not matter. Encode light as sRGB first, by
        `eigengs_dr.image.color.to_coded`.
    space : {"rgb", "ycbcr", "data", "pu21"}
        Space in which the mean squared error over all pixels and channels is computed.
    weight : array_like, shape (H, W), (H, W, 1) or (H, W, C), optional
        Factors of the squared errors of pixels, or of their channels in that space; finite and at
        least 0. The mean squared error is then ``sum w e^2 / sum w``. Pixels of weight 0 do not
        count, and may be NaN.

    Returns
    -------
    float
        ``10 log10(peak^2 / mse)``; infinite for equal images, NaN if a pixel is NaN. Computed in
        double precision, strip by strip, without a copy of an image.

    Raises
    ------
    ValueError
        If the shapes differ, shapes or dtypes are not as above, the space is unknown, or a weight
        is negative or not finite, or all are 0.

    Examples
    --------
    >>> round(psnr(np.zeros((4, 4, 3)), np.full((4, 4, 3), 0.1), space="ycbcr"), 2)
    26.09
    """
    total = squared_error(a, b, space, weight)
    return psnr_from_mse(total / (3 * math.prod(np.shape(a)[:2])))


def squared_error(a: ArrayLike, b: ArrayLike, space: str, weight: ArrayLike | None = None) -> float:
    """Return the sum of the squared errors of two images, from which `psnr` is computed.

    Sums of the parts of an image add up to the sum of the image. Grey images count as three
    channels. Weights are divided by their mean. For parameters and errors see `psnr`.
    """
    if space not in COMPARED:
        raise ValueError(f"space {space!r} is unknown; use one of {', '.join(COMPARED)}")
    a, b = _pixels(a), _pixels(b)
    x, y = _pair(a, b)
    factors = _weight_of(np.shape(a), weight)

    def squares(rows: slice) -> float:
        p, q = (image[rows].astype(np.float64) for image in (x, y))
        return _sum_squares(p, q, space, None if factors is None else factors[rows])

    return sum(map_threads(squares, strips(*x.shape[:2])))


def _sum_squares(
    a: NDArray[np.floating], b: NDArray[np.floating], space: str, weight: Singles | None
) -> float:
    """Return the sum of the squared differences of two images in a space; may overwrite both."""
    compared = COMPARED[space]
    difference, matrix = compared.difference(a, b), compared.matrix
    if weight is not None:
        with np.errstate(invalid="ignore"):  # pixels of weight 0 may have any value
            squares = weight * np.square(difference if matrix is None else difference @ matrix.T)
        return float(squares.sum(where=weight > 0)) / compared.peak**2
    if matrix is not None:
        # |M d|^2 = trace(M d d^T M^T): the sums of the products of R, G and B suffice.
        rows = difference.reshape(-1, 3)
        products = rows.T @ rows
        with np.errstate(invalid="ignore"):  # an image that is not finite has the PSNR NaN
            return float(np.trace(matrix @ products @ matrix.T))
    return float(np.square(difference, out=difference).sum()) / compared.peak**2


def _minus(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.floating]:
    return np.subtract(a, b, out=a)


class _Compared(NamedTuple):
    """How `psnr` compares two images: their difference, perhaps times a matrix, and the peak."""

    difference: Callable[..., NDArray[np.floating]] = _minus
    matrix: NDArray[np.float64] | None = None
    peak: int = 1


COMPARED = {
    "rgb": _Compared(lambda a, b: _minus(to_8bit(a, out=a), to_8bit(b, out=b)), peak=255),
    "ycbcr": _Compared(matrix=RGB_TO_YCBCR),
    "data": _Compared(),
    "pu21": _Compared(lambda a, b: _minus(to_pu21(to_linear(a)), to_pu21(to_linear(b)))),
}
"""The spaces in which `psnr` compares images."""


def psnr_from_mse(mse: float) -> float:
    """Return ``10 log10(1 / mse)``, the PSNR of a mean squared error for peak 1; inf for 0."""
    return math.inf if mse == 0 else -10 * math.log10(mse)


if TYPE_CHECKING:

    @overload
    def ssim(a: DrJitArray, b: ArrayLike, weight: ArrayLike | None = None) -> Float: ...

    @overload
    def ssim(a: ArrayLike, b: DrJitArray, weight: ArrayLike | None = None) -> Float: ...

    @overload
    def ssim(a: npt.ArrayLike, b: npt.ArrayLike, weight: npt.ArrayLike | None = None) -> float: ...


def ssim(a: Any, b: Any, weight: Any = None) -> Any:
    """Compute the structural similarity of two images, with the settings of Wang et al. 2004.

    Images are clamped to [0, 1]. The window is Gaussian, 11 pixels wide with sigma 1.5. The mean is
    taken over the channels and over the pixels whose window lies inside the image. If a side is
    shorter than 11 pixels, the window shrinks to the largest odd size that fits.

    For Dr.Jit tensors, such as those from `eigengs_dr.render`, the function is differentiable with
    respect to both images in forward and reverse mode. It then clamps neither image, so that values
    outside [0, 1] have derivatives too.

    Parameters
    ----------
    a, b : array_like, shape (H, W, 3) or (H, W, 1); or Dr.Jit tensor, shape (H, W, C)
        RGB or grey: floats with 1 as white, or bool, uint8, uint16 (scaled to
        [0, 1]). Their order does not matter. Tensors hold floats of ``drjit.llvm.ad`` or of another
        backend, and have any number of channels. If one image is an array, it is uploaded at every
        call; a function recorded by `drjit.freeze` keeps the array of the recording.
    weight : array_like, or tensor, shape (H, W), (H, W, 1) or (H, W, C), optional
        Factors w of the similarity s of the window around each pixel, or of each channel of it;
        finite and at least 0, which is not checked for a tensor. The mean is then
        ``sum w s / sum w``. Windows of weight 0 do not count, but their pixels belong to other
        windows too: NaN there gives NaN. Weights get no derivatives.

    Returns
    -------
    float; or Float, shape (1,)
        At most 1; 1 for equal images, but for rounding. A Dr.Jit array if `a` or `b` is a tensor,
        in double precision if one of them is.

    Raises
    ------
    ValueError
        If the shapes differ, shapes or dtypes are not as above, a weight is negative or not finite,
        all weights of windows are 0, or tensors are too large for 32-bit indices.

    References
    ----------
    Z. Wang, A. Bovik, H. Sheikh, E. Simoncelli: Image quality assessment: from error visibility to
    structural similarity. IEEE Transactions on Image Processing 13(4), 2004.

    Notes
    -----
    The result equals that of `skimage.metrics.structural_similarity` to 7 digits. Arrays are
    compared in double precision by Dr.Jit's default backend, strip by strip: images of any size
    take little memory, and half the time of NumPy from a megapixel on.

    Examples
    --------
    >>> import drjit as dr
    >>> import eigengs_dr as eg
    >>> g = eg.Gaussians.from_arrays([[8, 8]], [[0.5, 0, 0.5]], [[1]], size=(16, 16), space="data")
    >>> picture = eg.render(g)
    >>> dr.enable_grad(picture)
    >>> dr.backward(1 - eg.ssim(picture, dr.zeros(type(picture), picture.shape)))
    >>> dr.grad(picture).shape
    (16, 16, 1)
    """
    if is_tensor(a) or is_tensor(b):
        from .structure import similarity  # the command line reads this file without Dr.Jit

        x, y = (v if is_tensor(v) else _scaled(v) for v in (a, b))
        _check_shapes(x.shape, y.shape)
        return similarity(x, y, _weight_of_windows(x.shape, weight), _window(x.shape))
    a, b = _pixels(a), _pixels(b)
    x, y = _pair(a, b)
    factors = _weight_of_windows(np.shape(a), weight)
    return float(_similarity(x, y, lambda rows: np.clip(rows, 0, 1), factors)[0].mean())


@checks_types
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
    all five scales. With fewer scales, the exponents are scaled to the same sum. If the smaller
    side is below 11 pixels, the window shrinks to the largest odd size that fits.

    Parameters
    ----------
    a, b : array_like, shape (H, W, 3) or (H, W, 1)
        RGB or grey: floats with 1 as white, or bool, uint8, uint16 (scaled to
        [0, 1]). Their order does not matter.
    space : {"ycbcr", "data"}
        Channels to compare: Y, Cb and Cr, or the channels of the images.

    Returns
    -------
    float
        In [0, 1]; 1 for equal images.

    Raises
    ------
    ValueError
        If the shapes differ, shapes or dtypes are not as above, or the space is unknown.

    References
    ----------
    Z. Wang, E. Simoncelli, A. Bovik: Multiscale structural similarity for image quality assessment.
    Asilomar Conference on Signals, Systems and Computers, 2003. The variant is that of
    https://github.com/VainF/pytorch-msssim.
    """
    conversions: dict[str, Convert] = {"ycbcr": rgb_to_ycbcr, "data": np.asarray}
    if space not in conversions:
        raise ValueError(f"space {space!r} is unknown; use 'ycbcr' or 'data'")
    x, y = _pair(a, b)
    convert = conversions[space]
    side = min(x.shape[:2])
    scales = max(1, sum(side >> j >= WINDOW_SIDE for j in range(len(SCALE_WEIGHTS))))
    weights = np.array(SCALE_WEIGHTS[:scales]) * (sum(SCALE_WEIGHTS) / sum(SCALE_WEIGHTS[:scales]))

    product = np.ones(3)
    for weight in weights[:-1]:
        product *= np.maximum(_similarity(x, y, convert)[1], 0) ** weight
        x, y = halve(x), halve(y)
    product *= np.maximum(_similarity(x, y, convert)[0], 0) ** weights[-1]
    return float(product.mean())


def _pixels(image: ArrayLike) -> Pixels:
    """Return the pixels of an array or a picture of Pillow; a file may hold light."""
    if isinstance(image, (str, os.PathLike)):
        raise TypeError(f"{image}: is a path; compare the pixels, as from eigengs_dr.load_image")
    return np.asarray(read_image(image, True, "srgb").pixels)


def _scaled(image: ArrayLike) -> Pixels:
    """Scale integers to [0, 1] by their type; floats are not changed."""
    image = _pixels(image)
    peak = peak_of(image.dtype)
    return image if image.dtype.kind == "f" else image / np.float64(peak)


def _pair(a: ArrayLike, b: ArrayLike) -> tuple[Pixels, Pixels]:
    """Return both images as RGB of one shape (H, W, 3) without a copy; grey is replicated."""
    x, y = map(_scaled, (a, b))
    _check_shapes(x.shape, y.shape, (1, 3))
    shape = (*x.shape[:2], 3)
    return np.broadcast_to(x, shape), np.broadcast_to(y, shape)


def _check_shapes(
    a: tuple[int, ...], b: tuple[int, ...], channels: tuple[int, ...] | None = None
) -> None:
    """Raise ValueError unless both images have the same shape (H, W, C) with an allowed C."""
    if a != b:
        raise ValueError(f"images have shapes {a} and {b}; crop or scale one of them")
    if len(a) != 3 or (channels and a[2] not in channels) or 0 in a:
        shapes = " or ".join(f"(H, W, {c})" for c in channels or "C")
        raise ValueError(f"images have shape {a}; expected {shapes}, not empty")


def _weight_of(shape: tuple[int, ...], weight: ArrayLike | None) -> Singles | None:
    """Return the weights of images as an array (H, W, 1) or (H, W, C) with mean 1."""
    factors = check_weight(weight)
    if factors is None:
        return None
    _check_weight_shape(shape, factors.shape)
    return np.atleast_3d(factors)


def _check_weight_shape(shape: tuple[int, ...], weight: tuple[int, ...]) -> None:
    height, width, channels = shape
    if weight[:2] != (height, width):
        raise ValueError(f"weight has shape {weight}, but the images have {width}x{height} pixels")
    if len(weight) != 2 and weight[2:] not in ((1,), (channels,)):
        raise ValueError(
            f"weight has shape {weight}, but the images have {channels} channels; give (H, W), or "
            f"(H, W, {channels})"
        )


def _weight_of_windows(shape: tuple[int, ...], weight: Any) -> Any:
    """Check the weights of SSIM, and normalize arrays to the mean 1 over the windows."""
    if is_tensor(weight):
        _check_weight_shape(shape, weight.shape)
        return weight
    factors, radius = _weight_of(shape, weight), len(_window(shape)) - 1
    if factors is None:
        return None
    height, width = shape[:2]
    mean = factors[radius : height - radius, radius : width - radius].mean(dtype=np.float64)
    if not mean:
        raise ValueError(
            f"weight is 0 for all windows inside the image, whose centres are {radius} pixels or "
            "more from its edges; at least one must count"
        )
    return factors / np.float32(mean)


WINDOW_SIDE = 11
"""Side of the Gaussian window of SSIM and MS-SSIM, in pixels."""

WINDOW_DEVIATION = 1.5
"""Standard deviation of the window, in pixels."""

Convert = Callable[[NDArray[np.floating]], NDArray[np.floating]]
"""Converts rows of an image in double precision."""


def _window(shape: tuple[int, ...]) -> Doubles:
    """Return one half of the window of SSIM along an axis, for images of shape (H, W, C)."""
    radius = min(WINDOW_SIDE // 2, (min(shape[:2]) - 1) // 2)
    half = np.exp(-0.5 * np.square(np.arange(radius + 1) / WINDOW_DEVIATION))
    return np.asarray(half / (2 * half.sum() - half[0]))


def _similarity(
    x: Pixels, y: Pixels, convert: Convert, weight: Singles | None = None
) -> tuple[Doubles, Doubles]:
    """Return mean SSIM and mean contrast-structure term per channel of two (H, W, 3) images.

    The images are converted and compared strip by strip, so that large ones need no copy in double
    precision. Only pixels whose window lies inside the image count. Weights (H, W, 1) or (H, W, 3)
    have the mean 1 over these pixels.
    """
    from .structure import plane_sums  # the command line reads this file without Dr.Jit

    taps = _window(x.shape)
    reach = 2 * (len(taps) - 1)
    rows, columns = (side - reach for side in x.shape[:2])
    factors = None if weight is None else np.broadcast_to(weight, x.shape)
    sums = np.zeros((3, 2))
    for strip in strips(rows, columns):
        inside = slice(strip.start, strip.stop + reach)
        p, q = (convert(image[inside].astype(np.float64)) for image in (x, y))
        for k in range(3):
            w = None if factors is None else factors[inside, :, k]
            sums[k] += plane_sums(p[..., k], q[..., k], w, taps)
    similarity, structure = sums.T / (rows * columns)
    return similarity, structure


def halve(image: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the means of the 2x2 blocks of an image (H, W, C); drop an odd last row or column."""
    even = image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2]
    quarters = (even[row::2, column::2] for row in (0, 1) for column in (0, 1))
    return np.asarray(sum(quarters, np.zeros(1)) / 4)

"""The target of a fit for cameras: the smoothest texture that looks like the image to them.

Cameras see means over pixels (`eigengs_dr.scene.visibility`): ``R x`` of a texture x. Many textures
look like the image to all cameras; a smooth one needs few Gaussians. The iteration starts from B x,
the image blurred by a fraction of the footprint of each texel, and repeats

    t <- t + B R+ (R x - R t).

For each texel, R+ averages the residuals of the pixels that see it. This is a smoothed Landweber
iteration; in super-resolution it is called back-projection (Irani and Peleg, 1991). The iteration
restores the details that pixels see, and leaves out the details that no pixel sees. The blur is
chosen by what the cameras see, and errors are weighed by how much of a pixel a texel fills.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, zoom
from scipy.sparse import csr_array

from ..image.space import Space
from ..plugins.cone import PIXEL
from .visibility import Visibility

ITERATIONS = 20
"""Steps of the back-projection."""

Image = NDArray[np.float32]


def extrapolate(values: Image, seen: NDArray[np.bool_]) -> Image:
    """Replace unseen texels of an image by a smooth continuation of the seen ones.

    Push and pull (Gortler et al., The Lumigraph, 1996): each level of a pyramid has the means of
    the seen texels of the level below, and what is unseen there interpolates the level above. The
    cost is linear in the texels.

    Parameters
    ----------
    values : ndarray of float32, shape (H, W, C)
    seen : ndarray of bool, shape (H, W)
        True for at least one texel.

    Returns
    -------
    ndarray of float32, shape (H, W, C)
        Equal to `values` at seen texels.
    """
    mask = seen[..., None]
    levels = [(np.where(mask, values, np.float32(0)), mask.astype(np.float32))]
    while max(levels[-1][1].shape) > 1:
        mean, share = levels[-1]
        weight = _sum_of_blocks(share)
        mean = _sum_of_blocks(mean * share) / np.maximum(weight, np.float32(1e-9))
        levels.append((mean, np.minimum(weight, 1)))
    filled = levels[-1][0]
    for mean, share in reversed(levels[:-1]):
        filled = share * mean + (1 - share) * _doubled(filled, *mean.shape[:2])
    return np.where(mask, values, filled)


def _sum_of_blocks(image: Image) -> Image:
    """Return sums over 2 x 2 texels; the last row and column count twice if their side is odd."""
    height, width, channels = image.shape
    even = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    blocks = even.reshape(-(-height // 2), 2, -(-width // 2), 2, channels)
    return np.asarray(blocks.sum(axis=(1, 3)), np.float32)


def _mean_of_blocks(image: Image) -> Image:
    return _sum_of_blocks(image) * np.float32(0.25)


def _doubled(image: Image, height: int, width: int) -> Image:
    """Interpolate an image of values for 2 x 2 texels at these texels."""
    larger = zoom(image, (2, 2, 1), order=1, mode="nearest", grid_mode=True)
    return np.asarray(larger[:height, :width], np.float32)


def back_project(whole: Image, visibility: Visibility, share: float) -> Iterator[Image]:
    """Blur an image by a fraction of its footprints, then restore the details that pixels see.

    Yields the texture before the first step and after each of them.

    Parameters
    ----------
    whole : ndarray of float32, shape (H, W, C)
        Image in [0, 1], with the unseen texels from `extrapolate`.
    visibility : Visibility
    share : float
        Standard deviation of the blur B, as a fraction of that of the footprint.

    Yields
    ------
    ndarray of float32, shape (H, W, C)
        Texture in [0, 1]. Every step clamps it to this range, as the plugin clamps its sums.
    """
    blur = _blur_by(np.where(visibility.seen, visibility.footprint, np.inf) * share)
    flat = whole.reshape(-1, whole.shape[2])
    rows = visibility.pixel_to_texel
    goal = [r @ flat for r in rows]
    weight = np.maximum(sum(np.asarray(r.sum(axis=0)) for r in rows), 1e-9)[:, None]
    target = blur(whole)
    yield target
    for _ in range(ITERATIONS):
        missed = [g - r @ target.reshape(flat.shape) for g, r in zip(goal, rows, strict=True)]
        returned = sum(r.T @ m for m, r in zip(missed, rows, strict=True)) / weight
        target = (target + blur(returned.reshape(whole.shape).astype(np.float32))).clip(0, 1)
        yield target


def _blur_by(deviation: NDArray[np.floating]) -> Callable[[Image], Image]:
    """Return a blur with a different standard deviation, in texels, at every texel.

    The blur interpolates between uniform blurs whose standard deviations differ by sqrt(2). Images
    that are blurred by `COARSE` texels are halved, so that the cost does not grow with the
    deviation. Halving adds the variance 1/4, and interpolating 3/16 of a coarser texel. Texels
    with an infinite deviation get the largest finite one.
    """
    finite = np.isfinite(deviation)
    low, high = float(deviation[finite].min()), float(deviation[finite].max())
    last = math.ceil(2 * math.log2(high / low) - 1e-3)
    level: Image = np.float32(2 * np.log2(np.where(finite, deviation, high) / low))[..., None]
    levels, added, texel = [], [], 1
    halved, interpolated = 0.0, 0.0  # variances of a base, and of the way back from it
    for number in range(last + 1):
        variance = low**2 * 2**number
        if number and variance / 2 >= (COARSE * texel) ** 2:  # of the blur before
            halved = variance / 2 - interpolated + texel**2 / 4
            texel, level = 2 * texel, _mean_of_blocks(level)
            interpolated += 3 / 16 * texel**2
        levels.append(level)
        added.append(math.sqrt(variance - halved - interpolated) / texel)

    def blur(image: Image) -> Image:
        base, blurred = image, list[Image]()
        for sigma, level in zip(added, levels, strict=True):
            if base.shape[:2] != level.shape[:2]:
                base = _mean_of_blocks(blurred[-1])
            blurred.append(gaussian_filter(base, (sigma, sigma, 0), mode="nearest"))
        result = blurred[last]
        for number in reversed(range(last)):
            sharper = blurred[number]
            if result.shape != sharper.shape:
                result = _doubled(result, *sharper.shape[:2])
            result = sharper + (levels[number] - number).clip(0, 1) * (result - sharper)
        return result

    return blur


COARSE = 2.0
"""Standard deviation in texels from which images are halved before they are blurred further."""

BLURS = (0.4, 0.25, 0.15, 0.1)
"""Standard deviations in pixels of the blur of the back-projection. `smoothest_target` takes the
first one that leaves `MARGIN`."""

MARGIN, CLEAR = 6.0, 12.0
"""Fewest decibels between the PSNR of the target and the PSNR that its Gaussians must reach; and
those from which on more steps would only take time: its errors then are 6 % of theirs."""

EVEN = 2.0
"""Standard deviation in texels of the blur of the weights, because rays hit texels unevenly."""


def seen_by(
    texels: Image, rows: csr_array, space: Space, peak: float = 1.0
) -> NDArray[np.floating]:
    """Return what the pixels of a camera see of a texture.

    Parameters
    ----------
    texels : ndarray of float32, shape (H, W, C)
        Linear light or data, divided by `peak`; clamped to [0, 1].
    rows : scipy.sparse array, shape (n, H * W)
        One of `Visibility.pixel_to_texel`.
    space : {"linear", "data"}
        Whether means of light are coded as sRGB.
    peak : float, optional
        If it is above 1, light counts as it is and divided by the peak: it also lights the scene.

    Returns
    -------
    ndarray, shape (n, 1 or 2, C)
    """
    looks = (rows @ texels.clip(0, 1).reshape(-1, texels.shape[2]))[:, None]
    if peak > 1:
        looks = np.concatenate([looks, peak * looks], axis=1)
    return np.asarray(space.display(looks))


def smoothest_target(
    values: Image, visibility: Visibility, closeness: Callable[[Image], float], target_psnr: float
) -> Image:
    """Find the target of the fit: the smoothest texture that is close enough, or else the image.

    Parameters
    ----------
    values : ndarray of float32, shape (H, W, C)
    visibility : Visibility
    closeness : callable
        Lowest PSNR in dB with which a camera takes a texture for the image.
    target_psnr : float
        That of the Gaussians.

    Returns
    -------
    ndarray of float32, shape (H, W, C)
    """
    whole = extrapolate(values, visibility.seen)
    for share in BLURS:
        for target in back_project(whole, visibility, share / PIXEL):
            reached = closeness(target)
            if reached >= target_psnr + CLEAR:
                return target
        if reached >= target_psnr + MARGIN:
            return target
    return whole


def error_weights(visibility: Visibility, target: Image, space: Space) -> Image:
    """Return factors of the squared errors: each texel's share of the pixels.

    Parameters
    ----------
    visibility : Visibility
    target : ndarray of float32, shape (H, W, C)
    space : {"linear", "data"}
        In linear light dark texels weigh more, see `eigengs_dr.image.space.DARKNESS`.

    Returns
    -------
    ndarray of float32, shape (H, W, C)
    """
    share = gaussian_filter(visibility.pixels, EVEN) * visibility.seen
    weight = (share / share.max())[..., None]
    darkness = space.weight(target)
    return (weight * (np.ones_like(target) if darkness is None else darkness)).astype(np.float32)

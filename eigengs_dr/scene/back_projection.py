"""Back-projection: a smooth texture that looks like an image to all cameras.

Cameras see means over pixels (`eigengs_dr.scene.visibility`): ``R x`` of a texture x. Many textures
look like the image to all cameras; a smooth one needs few Gaussians. The iteration starts from B x,
the image blurred by a fraction of the footprint of each texel, and repeats

    t <- t + B R+ (R x - R t).

For each texel, R+ averages the residuals of the pixels that see it. This is a smoothed Landweber
iteration; in super-resolution it is called back-projection (Irani and Peleg, 1991). The iteration
restores the details that pixels see, and leaves out the details that no pixel sees.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from .visibility import Visibility

ITERATIONS = 20
"""Steps of the back-projection."""

KNOWN = 0.3
"""Fraction of seen texels under a kernel at which their mean fully replaces that of the next wider
kernel."""

Image = NDArray[np.float32]


def extrapolate(values: Image, seen: NDArray[np.bool_]) -> Image:
    """Replace unseen texels of an image by a smooth continuation of the seen ones.

    The value of an unseen texel is the mean of the seen texels under a Gaussian kernel, which is
    narrow near seen texels and wide far from them.

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
    known = seen[..., None].astype(np.float32)
    result = np.broadcast_to(values[seen].mean(axis=0, dtype=np.float32), values.shape)
    for power in reversed(range(max(seen.shape).bit_length())):
        sigma = (2.0**power, 2.0**power, 0)
        near = gaussian_filter(known, sigma, mode="nearest")
        means = gaussian_filter(values * known, sigma, mode="nearest") / np.maximum(near, 1e-9)
        result = result + np.minimum(near / KNOWN, 1) * (means - result)
    return np.where(seen[..., None], values, result)


def back_project(whole: Image, found: Visibility, share: float) -> Image:
    """Blur an image by a fraction of its footprints, then restore the details that pixels see.

    Parameters
    ----------
    whole : ndarray of float32, shape (H, W, C)
        Image in [0, 1], with the unseen texels from `extrapolate`.
    found : Visibility
    share : float
        Standard deviation of the blur B, as a fraction of that of the footprint.

    Returns
    -------
    ndarray of float32, shape (H, W, C)
        Texture in [0, 1]. Every step clamps it to this range, as the plugin clamps its sums.
    """
    blur = _blur_by(np.where(found.seen, found.footprint, np.inf) * share)
    flat = whole.reshape(-1, whole.shape[2])
    rows = found.pixel_to_texel
    goal = [r @ flat for r in rows]
    weight = np.maximum(sum(np.asarray(r.sum(axis=0)) for r in rows), 1e-9)[:, None]
    target = blur(whole)
    for _ in range(ITERATIONS):
        missed = [g - r @ target.reshape(flat.shape) for g, r in zip(goal, rows, strict=True)]
        returned = sum(r.T @ m for m, r in zip(missed, rows, strict=True)) / weight
        target = (target + blur(returned.reshape(whole.shape).astype(np.float32))).clip(0, 1)
    return target


def _blur_by(deviation: NDArray[np.floating]) -> Callable[[Image], Image]:
    """Return a blur with a different standard deviation, in texels, at every texel.

    The blur interpolates between uniform blurs whose standard deviations differ by sqrt(2). Texels
    with an infinite deviation get the largest finite one.
    """
    finite = np.isfinite(deviation)
    low, high = float(deviation[finite].min()), float(deviation[finite].max())
    count = 1 + int(np.ceil(2 * np.log2(high / low) - 1e-3))
    levels = low * np.sqrt(2) ** np.arange(count)
    level = 2 * np.log2(np.where(finite, deviation, high) / low)

    def blur(image: Image) -> Image:
        result = np.zeros_like(image)
        for number, sigma in enumerate(levels):
            part = np.maximum(1 - np.abs(level - number), 0).astype(np.float32)[..., None]
            result += part * gaussian_filter(image, (sigma, sigma, 0), mode="nearest")
        return result

    return blur

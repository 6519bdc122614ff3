"""The smoothest texture that cameras take for an image.

Cameras see means over pixels (`eigengs_dr.scene.visibility`): ``R x`` of a texture x. Many textures
look like the image to all of them, and the smoothest takes the fewest Gaussians. It is approached
from the image blurred by a part of each texel's footprint, B x, by steps of

    t <- t + B R+ (R x - R t),

with R+ the mean, over the pixels that see a texel, of what they miss: Landweber's iteration,
smoothed; in super-resolution it is called back-projection (Irani and Peleg, 1991). What blurring
took from the pixels comes back; what they do not see stays away.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from .visibility import Visibility

ITERATIONS = 20
"""Steps in which a texture gets back what the pixels miss."""

KNOWN = 0.3
"""Share of seen texels under a Gaussian from which their mean replaces that of a wider one."""

Image = NDArray[np.float32]


def extrapolate(values: Image, seen: NDArray[np.bool_]) -> Image:
    """Continue an image smoothly to where it is not seen: there, nothing shall bend it.

    By means of the texels that are seen under Gaussians, narrow ones near to these, and far away
    wider ones.

    Parameters
    ----------
    values : ndarray of float32, shape (H, W, C)
    seen : ndarray of bool, shape (H, W)
        True somewhere.

    Returns
    -------
    ndarray of float32, shape (H, W, C)
        `values` where they are seen.
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
    """Blur an image by a share of its footprints, then bring back what pixels see of it.

    Parameters
    ----------
    whole : ndarray of float32, shape (H, W, C)
        In [0, 1], also where it is not seen; see `extrapolate`.
    found : Resolution
    share : float
        Standard deviation of B over that of the footprint.

    Returns
    -------
    ndarray of float32, shape (H, W, C)
        In [0, 1]: each step is brought back to it, as what a texture sums is.
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
    """Make a blur whose standard deviation, in texels, differs from place to place.

    Between images that are blurred evenly, each by sqrt(2) more than the last; where the deviation
    is infinite, as where it is largest.
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

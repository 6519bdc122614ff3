"""Families of low rank, and what two bases have to share."""

from functools import cache

import numpy as np
from skimage.color import rgb2ycbcr

import eigengs_dr as eg

WIDTH, HEIGHT = SIZE = (14, 11)
PIXELS = WIDTH * HEIGHT


def family(count=60, directions=20, noise=0.004, seed=0, size=SIZE):
    """RGB images of low rank with falling variances, and noise."""
    rng = np.random.default_rng(seed)
    basis = rng.normal(size=(directions, size[1], size[0], 3))
    weights = rng.normal(size=(count, directions)) * 0.06 * 0.8 ** np.arange(directions)
    images = (
        0.5 + np.tensordot(weights, basis, 1) + noise * rng.normal(size=(count, *basis[0].shape))
    )
    return np.clip(images, -0.4, 1.4).astype(np.float32)


def planes(images, space="ycbcr"):
    """Images as planes of their channels in float64, shape (count, 3, pixels)."""
    images = images.astype(np.float64)
    values = rgb2ycbcr(images) / 255 if space == "ycbcr" else images
    return np.moveaxis(values, 3, 1).reshape(len(images), 3, -1)


def assert_same(a, b):
    """Equal to the last bit."""
    for name in ("mean", "variance", "count", "space"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), name)
    for name in ("components", "eigenvalues"):
        for x, y in zip(getattr(a, name), getattr(b, name), strict=True):
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y, name)


@cache
def basis_of(space):
    """Components of `family`: 12 of the first channel, 5 of the others."""
    return eg.Eigenbasis.from_images(family(), SIZE, (12, 5, 5), space=space)

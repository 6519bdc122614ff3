"""Families of images, their components, and models of them."""

from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import eigengs_dr as eg


def family(count=40, side=32, seed=0):
    """RGB images of low-pass noise, shape (count, side, side, 3)."""
    noise = np.random.default_rng(seed).normal(size=(count, side, side, 3))
    smooth = gaussian_filter(noise, (0, 3, 3, 0.5), mode="wrap")
    return (0.5 + 0.15 * smooth / smooth.std()).clip(0, 1).astype(np.float32)


@cache
def small_basis(space="ycbcr"):
    """Components of a family of 32x32 pixels: 12 of the first channel, 6 of the others."""
    return eg.Eigenbasis.from_images(family(), (32, 32), (12, 6, 6), space=space)


@cache
def small_model(backend, split=False, space="ycbcr"):
    """A model of `small_basis` with 100 splats."""
    return eg.EigenGS.fit(small_basis(space), 100, frequency_aware=split, backend=backend)


SIDE, SPLATS = 32, 100
"""Size of the images of a family, and splats of a small model."""

splits = pytest.mark.parametrize("split", [False, True])


def fidelity(pictures, images):
    """Mean PSNR of pictures in YCbCr."""
    return np.mean([eg.psnr(p, i, "ycbcr") for p, i in zip(pictures, images, strict=True)])


def rendered(model, images, *options):
    """Renderings of the codes of images."""
    return [eg.render(model.encode(image, *options)).numpy() for image in images]

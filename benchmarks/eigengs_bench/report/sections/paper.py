"""Figures that the paper prints, which tables show beside ours.

Tai et al., "EigenGS Representation", CVPR 2025: tables 1 (FFHQ), 2 (transfer) and 3 (ablation).
PSNR is in YCbCr, "SSIM" is MS-SSIM, seconds are of a V100 and count from after the start.
"""

from __future__ import annotations

from typing import NamedTuple


class Printed(NamedTuple):
    """A row of the paper: what was fitted and how, and its mean PSNR at some steps."""

    images: str
    method: str
    psnr: dict[int, float]


def _printed(images: str, method: str, *psnr: float | None) -> Printed:
    steps = (0, 100, 500, 1000, 5000, 10000)
    return Printed(
        images, method, {s: p for s, p in zip(steps, psnr, strict=True) if p is not None}
    )


PRINTED = {
    "cats512": [
        _printed("FFHQ, 512x512", "GaussianImage", None, 10.4, 21.8, 29.4, 39.2, 40.1),
        _printed("FFHQ, 512x512", "EigenGS, 300", 28.0, 34.4, 36.4, 37.5, 40.7, 41.8),
        _printed("FFHQ, 512x512", "EigenGS, 500", 28.9, 34.8, 36.7, 37.7, 40.8, 41.8),
    ],
    "faces256": [
        _printed("CelebA, 256x256", "GaussianImage", None, 10.3, 21.9, 30.0, 43.8, 45.2),
        _printed("CelebA, 256x256", "EigenGS of cats", 28.2, 36.2, 40.7, 43.2, 47.2, 48.2),
        _printed("CelebA, 256x256", "EigenGS of ImageNet", 28.7, 35.4, 39.6, 42.2, 46.3, 47.3),
    ],
    "cats256": [
        _printed("Cats, 256x256", "EigenGS of ImageNet", 29.6, 37.6, 41.1, 42.9, 45.9, 46.6),
    ],
}
"""Rows of tables 1 and 2, by the set of ours that comes closest."""

ABLATION = {
    ("ycbcr", "split"): {"CelebA": 47.2, "FFHQ": 41.8, "Cats": 45.7, "Cars": 44.7},
    ("ycbcr", "whole"): {"CelebA": 48.0, "FFHQ": 40.7, "Cats": 46.1, "Cars": 43.5},
    ("rgb", "split"): {"CelebA": 39.5, "FFHQ": 34.9, "Cats": 38.5, "Cars": 36.4},
    ("rgb", "whole"): {"CelebA": 39.9, "FFHQ": 33.3, "Cats": 38.9, "Cars": 35.1},
}
"""PSNR of table 3 after 10,000 steps, by colour space and split."""

"""Training of the basis "natural" of the package: ``python tools/train_natural.py FILE``.

The training images are random crops of the photos in scikit-image, of many sizes and positions,
mirrored at random. No position is special in this family of images, so its components are close
to waves of rising frequency, and every image contains such waves.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eigengs_dr.image.io import SAMPLES, sample
from eigengs_dr.image.resize import resample

DEMO = "coffee"
"""The photo of ``make demo``. It is no training image, so the demo shows a typical result."""

CROPS = 4000
"""Number of training images; the photos take turns."""

SMALLEST = 0.3
"""Side of the smallest crop, as a share of the shorter side of the photo. Sizes are log-uniform."""

SIDE = 256
"""Side of the basis in pixels."""

COMPONENTS = (230, 60, 60)
"""Number of components of Y, Cb and Cr. They fill 4 MB; chroma needs fewer than luma."""


def crops(count: int = CROPS, seed: int = 0) -> Iterator[NDArray[np.float32]]:
    """Yield random square crops of the photos of scikit-image.

    Parameters
    ----------
    count : int, optional
        Number of crops.
    seed : int, optional

    Yields
    ------
    ndarray of float32, shape (256, 256, 3)
        RGB, resampled by bicubic interpolation.
    """
    generator = np.random.default_rng(seed)
    photos = [sample(name) for name in SAMPLES if name != DEMO]
    for i in range(count):
        photo = photos[i % len(photos)]
        height, width = photo.shape[:2]
        share = np.exp(generator.uniform(np.log(SMALLEST), 0))
        side = max(1, round(share * min(height, width)))
        top, left = generator.integers(height - side + 1), generator.integers(width - side + 1)
        flips = generator.choice([-1, 1], 2)
        crop = photo[top : top + side, left : left + side][:: flips[0], :: flips[1]]
        yield resample(np.ascontiguousarray(crop), SIDE, SIDE)


def main(path: str) -> None:
    """Train the basis in about a minute and write it to a file."""
    from eigengs_dr.cli.console import bar
    from eigengs_dr.eigenbasis.basis import Eigenbasis
    from eigengs_dr.eigenbasis.eigengs import EigenGS

    with bar(False) as show:

        def advance(done: int, total: int | None, row: dict[str, Any]) -> None:
            show("natural", done, CROPS)

        basis = Eigenbasis.from_images(
            crops(), (SIDE, SIDE), components=COMPONENTS, progress=advance
        )
    EigenGS.fit(basis).save(path)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python tools/train_natural.py FILE.npz")
    main(sys.argv[1])

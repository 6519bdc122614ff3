"""The basis "natural", which ships with the package: ``python tools/train_natural.py FILE``.

It is trained on random crops of the photos inside scikit-image. At many sizes and places, mirrored
both ways, they make a family without a preferred place: its components are close to waves of
rising frequency, of which any image holds some.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eigengs_dr.image.resize import resample
from eigengs_dr.image.samples import SAMPLES, sample

DEMO = "coffee"
"""The photo of ``make demo``: not trained on, so that the demo shows what others can expect."""

CROPS = 4000
"""Number of training images, taken from the photos in turn."""

SMALLEST = 0.3
"""Side of the smallest crops, as a share of the photo's shorter side; sizes are log-uniform."""

SIDE = 256
"""Side of the basis in pixels."""

COMPONENTS = (230, 60, 60)
"""Components of Y, Cb and Cr: as many as 4 MB hold, and chroma needs fewer."""


def crops(count: int = CROPS, seed: int = 0) -> Iterator[NDArray[np.float32]]:
    """Cut random squares out of the photos that ship with scikit-image.

    Parameters
    ----------
    count : int, optional
    seed : int, optional

    Yields
    ------
    ndarray of float32, shape (256, 256, 3)
        RGB, bicubic.
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
    """Train the basis and write it to a file; it takes a minute."""
    from eigengs_dr.cli.console import progress_bar
    from eigengs_dr.eigenbasis.basis import Eigenbasis
    from eigengs_dr.eigenbasis.eigengs import EigenGS

    with progress_bar(False) as show:

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

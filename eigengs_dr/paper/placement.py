"""The initialization of GaussianImage: random Gaussians with random colours on black."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..fitting.objective import Pixels
from ..fitting.place import gaussians_at, random_shapes
from ..gaussian.gaussians import Gaussians


@dataclass(frozen=True)
class RandomColors:
    """Means uniform in the image, shapes of about a pixel, and colours uniform in [0, 1]."""

    has_colors = True

    def __call__(self, objective: Pixels, count: int, cutoff: float, seed: int) -> Gaussians:
        """Place Gaussians; see `eigengs_dr.fitting.place.Placement`."""
        generator = np.random.default_rng(seed)
        mean, factor = random_shapes(objective.size, count, generator)
        color = generator.uniform(0, 1, (count, objective.channels))
        return gaussians_at(objective, mean, factor, cutoff, color)

"""What levels of detail are worth: PSNR over how many splats of a set are drawn."""

from __future__ import annotations

from typing import Any

import numpy as np

from eigengs_bench.harness.store import Row
from eigengs_bench.harness.task import Progress, no_progress
from eigengs_bench.harness.timing import Image, require_complete
from eigengs_dr.color import rgb_to_ycbcr
from eigengs_dr.fitting import fit
from eigengs_dr.gaussians import Gaussians
from eigengs_dr.growth import worth
from eigengs_dr.levels import fit_levels, level_counts
from eigengs_dr.metrics import psnr
from eigengs_dr.rendering import picture_of

SAMPLE, SIDE = "coffee", 256
"""The photo of scikit-image that is fitted by default, and the side of its middle in pixels."""

BETWEEN = (1, 2)
"""Numbers of splats that are looked at, in each level, over those of the level before."""


def run(
    image: Image,
    gaussians: int,
    levels: int,
    iterations: int,
    seed: int = 0,
    backend: str | None = None,
    progress: Progress = no_progress,
) -> list[Row]:
    """Fit an image in levels, and by as many splats as are looked at.

    Parameters
    ----------
    image : ndarray of float32, shape (H, W, 3)
    gaussians, levels, iterations, seed, backend
        See `eigengs_dr.fit_levels`.
    progress : Progress, optional

    Returns
    -------
    list of dict
        A row a number of splats: "splats"; "level", whether a level ends there; and PSNRs in YCbCr
        of that many splats: "levels", the first of the set in levels; "alone", a fit of that many;
        "sorted", the most valuable ones of a fit without levels.
    """
    ends = level_counts(gaussians, levels)
    counts = sorted({factor * end for end in ends[:-1] for factor in BETWEEN} | {gaussians})
    settings: dict[str, Any] = {"iterations": iterations, "seed": seed, "backend": backend}
    progress("fits", 0, len(counts) + 1)
    nested = require_complete(fit_levels(image, gaussians, levels, **settings)).gaussians
    alone = {}
    for done, count in enumerate(counts, 1):
        progress("fits", done, len(counts) + 1)
        alone[count] = require_complete(fit(image, count, **settings)).gaussians
    plain = alone[gaussians]
    best = plain[np.argsort(-worth(plain, rgb_to_ycbcr(image)), kind="stable")]

    def reached(drawn: Gaussians) -> float:
        return psnr(picture_of(drawn), image, "ycbcr")

    return [
        {
            "splats": n,
            "level": n in ends,
            "levels": reached(nested[:n]),
            "alone": reached(alone[n]),
            "sorted": reached(best[:n]),
        }
        for n in counts
    ]

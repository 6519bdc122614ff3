"""What levels of detail are worth: PSNR over how many Gaussians of a set are drawn."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from eigengs_bench.harness.store import Progress
from eigengs_bench.harness.timing import Image
from eigengs_dr.fitting.density_control import removal_cost
from eigengs_dr.fitting.fit import fit
from eigengs_dr.fitting.options import Levels, level_counts
from eigengs_dr.image.color import rgb_to_ycbcr
from eigengs_dr.image.metrics import psnr
from eigengs_dr.raster.render import picture_of

# The photo of scikit-image that is fitted by default, and the side of its middle in pixels.
SAMPLE, SIDE = "coffee", 256


def run(
    image: Image,
    gaussians: int,
    levels: Levels,
    progress: Progress = lambda *_: None,
    **settings: Any,
) -> pd.DataFrame:
    """Fit an image in levels, and by fits of single numbers; see `fit` for the settings.

    A line a number of "splats": "level", whether a level ends there; and PSNRs in YCbCr of as many
    Gaussians: "levels", the first of the set in levels; "alone", a fit; "sorted", the most valuable
    ones of a fit without levels.
    """
    ends = level_counts(gaussians, levels)
    between = (round(math.sqrt(low * high)) for low, high in pairwise(ends))
    counts = sorted({*ends, *between})
    progress("fits", 0, len(counts) + 1)
    nested = fit(image, gaussians, levels=levels, **settings).gaussians
    alone = {}
    for done, count in enumerate(counts, 1):
        progress("fits", done, len(counts) + 1)
        alone[count] = fit(image, count, **settings).gaussians
    plain, rows = alone[gaussians], []
    best = plain[np.argsort(-removal_cost(plain, rgb_to_ycbcr(image)), kind="stable")]
    for n in counts:
        drawn = {"levels": nested[:n], "alone": alone[n], "sorted": best[:n]}
        reached = {key: psnr(picture_of(g), image, "ycbcr") for key, g in drawn.items()}
        rows.append({"splats": n, "level": n in ends, **reached})
    return pd.DataFrame(rows)

"""The method of GaussianImage, for `eigengs_dr.fit`.

Source: Zhang et al., "GaussianImage: 1000 FPS Image Representation and Compression by 2D Gaussian
Splatting" (ECCV 2024).
"""

from __future__ import annotations

from ..fitting.method import Method
from .adan import Adan
from .cholesky import Cholesky
from .placement import RandomColors

GAUSSIANIMAGE = Method(
    place=RandomColors(),
    controls=(),
    optimizer=Adan(),
    # One learning rate for all variables. GaussianImage halves it after 20,000 steps, which no fit
    # here reaches.
    rates={"mean": 1e-3, "cholesky": 1e-3, "color": 1e-3},
    coordinates=Cholesky(),
    warm_up=0,
    decay=1.0,
    drift=4e-3,
    rate_exponent=0.0,
)
"""The method of GaussianImage."""

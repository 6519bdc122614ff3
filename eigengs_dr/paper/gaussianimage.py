"""The method of GaussianImage, for `eigengs_dr.fit`: its start, its variables and its rates.

Source: Zhang et al., "GaussianImage: 1000 FPS Image Representation and Compression by 2D Gaussian
Splatting" (ECCV 2024). EigenGS uses the same variables.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import numpy as np

from ..backend.arrays import rcp, types_of
from ..backend.types import Float, FloatLike
from ..fitting.method import Method
from ..fitting.objective import Pixels
from ..fitting.place import gaussians_at, random_shapes
from ..fitting.state import ImageSize, Variables
from ..gaussian.covariance import cholesky_from_factor, factor_from_cholesky
from ..gaussian.gaussians import Gaussians
from .adan import Adan

CHOLESKY_BOUND = 0.5
"""Pixels that are added to the diagonal of the Cholesky factor, as in GaussianImage."""

MIN_DIAGONAL = 0.01
"""Smallest diagonal entry of the Cholesky factor in pixels. GaussianImage has no such bound, but an
entry that reaches 0 makes the covariance singular, and the set not finite."""


@dataclass(frozen=True)
class Cholesky:
    """atanh of the mean in [-1, 1], Cholesky factor of the covariance in pixels, and colour."""

    def encode(self, gaussians: Gaussians) -> Variables:
        """Return the variables; see `eigengs_dr.fitting.state.Coordinates`."""
        types = types_of(gaussians.mean)
        x, y = gaussians.mean
        sides = (dr.opaque(types.Float, side) for side in (gaussians.width, gaussians.height))
        width, height = sides
        l1, l2, l3 = cholesky_from_factor(*gaussians.factor)
        return {
            "mean": types.Float2(_atanh(2 * x / width - 1), _atanh(2 * y / height - 1)),
            "cholesky": types.Float3(l1 - CHOLESKY_BOUND, l2, l3 - CHOLESKY_BOUND),
            "color": gaussians.color,
        }

    def decode(self, fixed: Gaussians, variables: Variables, size: ImageSize = None) -> Gaussians:
        """Return the set; see `eigengs_dr.fitting.state.Coordinates`."""
        width, height = size or (fixed.width, fixed.height)
        mean, factor = fixed.mean, fixed.factor
        if "mean" in variables:
            x, y = (_share(v) for v in variables["mean"])
            mean = type(mean)(x * width, y * height)
        if "cholesky" in variables:
            l1, l2, l3 = variables["cholesky"]
            rows = factor_from_cholesky(l1 + CHOLESKY_BOUND, l2, l3 + CHOLESKY_BOUND)
            factor = type(factor)(rows)
        color = variables.get("color", fixed.color)
        return replace(fixed, mean=mean, factor=factor, color=color)

    def project(self, fixed: Gaussians, variables: Variables, size: ImageSize = None) -> Variables:
        """Bound the diagonal; see `eigengs_dr.fitting.state.Coordinates`."""
        if "cholesky" not in variables:
            return variables
        l1, l2, l3 = variables["cholesky"]
        minimum = MIN_DIAGONAL - CHOLESKY_BOUND
        bounded = type(variables["cholesky"])(dr.maximum(l1, minimum), l2, dr.maximum(l3, minimum))
        return {**variables, "cholesky": bounded}

    def reach(self, fixed: Gaussians, moves: dict[str, float]) -> tuple[FloatLike, float]:
        """Return the growth of ellipses; see `eigengs_dr.fitting.state.Coordinates`."""
        side = 0.5 * max(fixed.width, fixed.height)  # the slope of tanh is at most 1
        return moves.get("mean", 0.0) * side + moves.get("cholesky", 0.0) * fixed.cutoff, 1.0


FARTHEST = 40.0
"""Largest absolute value of a variable, beyond which nothing changes and `exp` would overflow."""


def _share(v: Float) -> Float:
    """Return ``(tanh(v) + 1) / 2``; on cuda, `drjit.tanh` of single precision has 11 bits."""
    return rcp(1 + dr.exp(-2 * dr.clip(v, -FARTHEST, FARTHEST)))


def _atanh(x: Float) -> Float:
    return dr.atanh(dr.clip(x, -0.999999, 0.999999))


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

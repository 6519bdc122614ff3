"""Perturbation: random moves of Gaussians, by which a descent leaves a poor local minimum.

Kheradmand et al. ("3D Gaussian splatting as Markov chain Monte Carlo", NeurIPS 2024) add noise to
means. Here shapes get noise too, and each Gaussian gets as much as the image can bear. A Gaussian
with the factor F, the size s (the geometric mean of its standard deviations) and the amplitude
``A = color s`` adds the squared error ``pi/2 |A|^2 |F dm|^2`` if its mean moves by dm, see
`eigengs_dr.codec.quantization`. So faint Gaussians move far, and those that carry the image stay
near their places; the nearer a fit is to its image, the smaller are the moves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

SHAPE_SHARE = 0.5
"""Noise of the logarithms of the sizes, relative to that of the mean in standard deviations."""

MAX_NOISE = 1.0
"""Largest noise of a mean, in standard deviations of its Gaussian."""


def perturb(
    arrays: dict[str, Array], own: NDArray[np.integer], error: float, strength: float, seed: int
) -> None:
    """Add noise to the mean and the factor of some Gaussians, in place.

    The noise is normal: ``F dm = e z`` for the mean, with two numbers z, and
    ``F' = [[exp(e u), e v], [0, exp(e w)]] F`` for the factor, with `SHAPE_SHARE` times such
    numbers u, v and w. Each mean alone adds about ``strength^2`` times the mean error:
    ``e = strength (error / (pi |A|^2))^(1/2)``, at most `MAX_NOISE`.

    Parameters
    ----------
    arrays : dict of ndarray
        mean (N, 2), factor (N, 3) and color (N, C), see `eigengs_dr.Gaussians`. Perturbed Gaussians
        may leave the image.
    own : ndarray of int, shape (n,)
        The Gaussians that move.
    error : float
        Squared error of the image divided by the number of Gaussians.
    strength : float
    seed : int
        Equal seeds give equal noise.
    """
    mean, factor, color = (arrays[k][own].astype(np.float64) for k in ("mean", "factor", "color"))
    a, b, c = factor.T
    amplitude = np.square(color).sum(axis=1) / (a * c)
    most = np.pi * amplitude * MAX_NOISE**2 > strength**2 * error
    ratio = np.divide(error, np.pi * amplitude, where=most, out=np.zeros_like(amplitude))
    size = np.where(most, strength * np.sqrt(ratio), MAX_NOISE)
    normal = np.random.default_rng(seed).standard_normal((5, len(own))) * size
    x, y, (u, v, w) = normal[0], normal[1] / c, SHAPE_SHARE * normal[2:]
    arrays["mean"][own] = mean + np.stack([(x - b * y) / a, y], axis=1)
    wider = np.exp(u)
    arrays["factor"][own] = np.stack([wider * a, wider * b + v * c, np.exp(w) * c], axis=1)

"""A splat seen through a Gaussian footprint: how wide that is, and what borders leave of both."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr

from ..parameters import EXP2_SCALE

MAX_FOOTPRINT = 0.4
"""Largest standard deviation of a footprint, in widths and heights of the texture. One that is as
wide as this in all directions sees the mean: what it leaves of a repeating texture is below
``exp(-(2 pi WIDEST)^2 / 2)`` = 4 % of its coarsest wave."""


def bound_covariance(metric: list) -> tuple[list, Any]:
    """Invert the metric of a footprint, with no axis longer than `MAX_FOOTPRINT`.

    Of a symmetric 2x2 matrix M with eigenvalues p > q is
    ``f(M) = f(q) + (M - q) (f(p) - f(q)) / (p - q)``; here ``f(p) = 1 / max(p, WIDEST^-2)``.

    Parameters
    ----------
    metric : list of 3 Float
        xx, xy, yy of the inverse covariance of the footprint, in widths and heights of the texture.

    Returns
    -------
    covariance : list of 3 Float
        xx, xy, yy.
    blind : Bool
        Where the footprint is so wide in all directions that only the mean is left, or not finite.
    """
    xx, xy, yy = metric
    floor = 1 / MAX_FOOTPRINT**2
    middle, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    root = dr.sqrt(dr.fma(half, half, xy * xy))
    p, q = middle + root, dr.maximum(middle - root, 0)
    blind = ~((p >= floor) & dr.isfinite(p))
    short, long = dr.rcp(dr.maximum(p, floor)), dr.rcp(dr.maximum(q, floor))
    slope = dr.select(root > 1e-6 * middle, (short - long) / (2 * root), 0)
    covariance = [dr.fma(slope, xx - q, long), slope * xy, dr.fma(slope, yy - q, long)]
    round_one = (MAX_FOOTPRINT**2, 0.0, MAX_FOOTPRINT**2)
    covariance = [dr.select(blind, r, c) for r, c in zip(round_one, covariance, strict=True)]
    return covariance, blind


def inside_share(shape: list, footprint: list, x: Any, y: Any, width: int, height: int) -> Any:
    """What part of ``footprint x splat`` lies in the image.

    The product of both Gaussians is one with the mean ``x - Sigma_f Sigma'^-1 (x - mu)`` and the
    covariance ``Sigma_f - Sigma_f Sigma'^-1 Sigma_f``. Its mass in a rectangle is taken for the
    product of the masses in the two strips: exact but near corners.

    Parameters
    ----------
    shape : list of 5 Float
        Of the widened splat, from `widen`.
    footprint : list of 3 Float
        As in `widen`.
    x, y : Float
        Centre of the footprint.
    width, height : int
    """
    mean_x, mean_y, a, b, c = shape
    fxx, fxy, fyy = footprint
    dx, dy = x - mean_x, y - mean_y
    u, v = dr.fma(a, dx, b * dy), c * dy
    gx, gy = a * u, dr.fma(b, u, c * v)

    def strip(center: Any, along: Any, across: Any, other: Any, variance: Any, side: int) -> Any:
        left = dr.fma(a, along, b * across), c * across
        rest = dr.maximum(variance - dr.fma(left[0], left[0], left[1] * left[1]), 1e-6)
        steep = dr.rsqrt(rest) * (math.sqrt(0.5) / EXP2_SCALE)
        middle = center - other
        return 0.5 * (quick_erf((side - middle) * steep) + quick_erf(middle * steep))

    shift_x, shift_y = dr.fma(fxx, gx, fxy * gy), dr.fma(fxy, gx, fyy * gy)
    return strip(x, fxx, fxy, shift_x, fxx, width) * strip(y, fxy, fyy, shift_y, fyy, height)


def quick_erf(x: Any) -> Any:
    """Error function to 0.005, at a fifth of the cost: the best odd polynomial that ends flat."""
    x = dr.clip(x, -2, 2)
    q = x * x
    p = dr.fma(dr.fma(dr.fma(-0.00595457, q, 0.07127595), q, -0.34688831), q, 1.12823041)
    return x * p

"""Gaussian footprints: their bounds, their part in the image, and Gaussians that they widen."""

from __future__ import annotations

import math

import drjit as dr

from ...backend.arrays import rcp, rsqrt
from ...backend.types import Bool, Float
from ..evaluate import falloff
from ..parameters import EXP2_SCALE, kernel_covariance
from .points import Packed, Terms

MAX_FOOTPRINT = 0.4
"""Largest standard deviation of a footprint, in widths and heights of the texture. A footprint that
has it in all directions sees the mean of a texture that repeats: it would keep at most
``exp(-(2 pi MAX_FOOTPRINT)^2 / 2)`` = 4 % of the coarsest wave of a repeating texture."""


def bound_covariance(metric: list) -> tuple[list, Bool]:
    """Invert the metric of a footprint, and shorten its axes to at most `MAX_FOOTPRINT`.

    A symmetric 2x2 matrix M with the eigenvalues p > q has
    ``f(M) = f(q) + (M - q) (f(p) - f(q)) / (p - q)``. Here ``f(p) = 1 / max(p, MAX_FOOTPRINT^-2)``.

    Parameters
    ----------
    metric : list of 3 Float
        xx, xy, yy of the inverse covariance of the footprint, in widths and heights of the texture.

    Returns
    -------
    covariance : list of 3 Float
        xx, xy, yy, in squared widths and heights of the texture. Where an axis is shortened, the
        derivative is 0.
    blind : Bool
        True if all axes are longer than `MAX_FOOTPRINT` or the metric is not finite: the caller
        should use the mean of the texture.
    """
    xx, xy, yy = dr.detach(metric)
    floor = 1 / MAX_FOOTPRINT**2
    middle, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    root = dr.sqrt(dr.fma(half, half, xy * xy))
    p, q = middle + root, dr.maximum(middle - root, 0)
    blind = ~((p >= floor) & dr.isfinite(p))
    short, long = rcp(dr.maximum(p, floor)), rcp(dr.maximum(q, floor))
    slope = dr.select(root > 1e-6 * middle, (short - long) / (2 * root), 0)
    covariance = [dr.fma(slope, xx - q, long), slope * xy, dr.fma(slope, yy - q, long)]
    round_one = (MAX_FOOTPRINT**2, 0.0, MAX_FOOTPRINT**2)
    covariance = [dr.select(blind, r, c) for r, c in zip(round_one, covariance, strict=True)]
    if dr.grad_enabled(metric):
        xx, xy, yy = metric
        inverse = rcp(dr.select(q >= floor, xx * yy - xy * xy, 1e30))
        slopes = [k * inverse for k in (yy, -xy, xx)]
        covariance = [dr.replace_grad(c, s) for c, s in zip(covariance, slopes, strict=True)]
    return covariance, blind


def extreme_variances(footprint: list) -> tuple[Float, Float]:
    """Return the smallest and the largest variance in any direction, without derivatives."""
    xx, xy, yy = dr.detach(footprint)
    middle, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    root = dr.sqrt(dr.fma(half, half, xy * xy))
    return middle - root, middle + root


def inside_share(
    shape: list, footprint: list, center: tuple, spans: list, at: tuple, free: list
) -> Float:
    """Return the part of the product of a footprint and a Gaussian that lies in a rectangle.

    The product is a Gaussian with the mean ``x - Sigma_f Sigma'^-1 (x - mu)`` and the covariance
    ``Sigma_f - Sigma_f Sigma'^-1 Sigma_f``. The masses in the vertical and the horizontal strip of
    the rectangle are multiplied. The result is exact except near corners.

    Beyond the border of a clamped image, a Gaussian is constant across the border. It then has the
    precision 0 along this axis, and along the other one its mean at the border.

    Parameters
    ----------
    shape : list of 5 Float
        The widened Gaussian, from `eigengs_dr.raster.evaluate.widen`.
    footprint : list of 3 Float
        As for `eigengs_dr.raster.evaluate.widen`.
    center : (Float, Float)
        Centre of the footprint, in pixels.
    spans : list of (Float, Float)
        Ends of the rectangle along x and along y.
    at : (Float, Float)
        Where the Gaussian is seen: the centre, but at the border on axes that are not free.
    free : list of 2 Float
        For x and y 1, or 0 where the Gaussian is constant along the axis.

    Returns
    -------
    Float
        In [0, 1].
    """
    mean_x, mean_y, a, b, c = shape
    fxx, fxy, fyy = footprint
    dx, dy = at[0] - mean_x, at[1] - mean_y
    u, v = dr.fma(a, dx, b * dy), c * dy
    a, b, c = a * free[0], b * free[1], c * free[1]
    gx, gy = a * u, dr.fma(b, u, c * v)

    def strip(k: int, along: Float, across: Float, other: Float, variance: Float) -> Float:
        left = dr.fma(a, along, b * across), c * across
        rest = dr.maximum(variance - dr.fma(left[0], left[0], left[1] * left[1]), 1e-6)
        steep = rsqrt(rest) * (math.sqrt(0.5) / EXP2_SCALE)
        middle, (low, high) = center[k] - other, spans[k]
        return 0.5 * (quick_erf((high - middle) * steep) + quick_erf((middle - low) * steep))

    shift_x, shift_y = dr.fma(fxx, gx, fxy * gy), dr.fma(fxy, gx, fyy * gy)
    return strip(0, fxx, fxy, shift_x, fxx) * strip(1, fxy, fyy, shift_y, fyy)


def quick_erf(x: Float) -> Float:
    """Return the error function to 0.005 at a fifth of its cost.

    The odd polynomial of degree 7 has the slope 0 at both ends of [-2, 2].
    """
    x = dr.clip(x, -2, 2)
    q = x * x
    p = dr.fma(dr.fma(dr.fma(-0.00595457, q, 0.07127595), q, -0.34688831), q, 1.12823041)
    return x * p


def filtered_terms(packed: Packed, footprint: list) -> tuple[Terms, tuple[Float, ...]]:
    """Return the `Terms` of the filtered sum, without borders, from inverted rows; what they share.

    With ``Sigma' = [[xx, xy], [xy, yy]]`` and its determinant D, the exponent
    ``d^T Sigma'^-1 d`` is ``((yy dx - xy dy)^2 / D + dy^2) / yy``; see
    `eigengs_dr.raster.evaluate.widen` for D.
    """
    fxx, fxy, fyy = kernel_covariance(footprint)
    determinant = dr.maximum(dr.fma(fxx, fyy, -fxy * fxy), 0)
    limit = packed.radius * packed.radius

    def terms(shape: list, color: list, x: Float, y: Float, *shared: Float) -> list:
        (fxx, fxy, fyy, determinant), (mean_x, mean_y, p, t, r) = shared, shape
        dx, dy = x - mean_x, y - mean_y
        xy, yy = dr.fma(t, r, fxy), dr.fma(r, r, fyy)
        across = dr.fma(r * r, fxx, t * dr.fma(t, fyy, -2 * r * fxy))
        pp = p * p
        scale = rsqrt(dr.fma(pp, yy, determinant + dr.maximum(across, 0)))
        along = dr.fma(yy, dx, -xy * dy) * scale
        w = falloff(dr.fma(along, along, dy * dy) * rcp(yy), limit) * scale
        return [w * c for c in color]

    shared = fxx, fxy, fyy, determinant
    if dr.grad_enabled(shared):
        return terms, shared
    # What a loop need not differentiate stays out of its state, which would cost a step 8 %.
    return lambda shape, color, x, y: terms(shape, color, x, y, *shared), ()

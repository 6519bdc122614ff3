"""Contributions of Gaussians that a footprint widens, for sums over lists."""

from __future__ import annotations

from typing import Any

import drjit as dr

from ...backend.arithmetic import rcp, rsqrt
from ..evaluate import falloff, weights, widen
from ..parameters import NUM_SHAPE_PARAMS, kernel_covariance
from .points import in_list_order


def widened_values(footprint: list, radius: float) -> Any:
    """Return the `terms` of `sum_at_points` for the filtered sum, without borders."""
    scaled = kernel_covariance(footprint)

    def terms(splat: list, x: Any, y: Any) -> list:
        shape, amplitude = widen(splat[:NUM_SHAPE_PARAMS], scaled)
        (w,) = weights(shape, x, y, (1, 1), radius)
        w = w * amplitude
        return [w * c for c in splat[NUM_SHAPE_PARAMS:]]

    return terms


def arrange(splat: Any, shape: list, color: list) -> Any:
    """Copy the parameters of a set to the order of lists, for `arranged_values`.

    Parameters
    ----------
    splat : UInt32
        Entries of the lists.
    shape, color : list of Float, shape (N,)

    Returns
    -------
    Float, or None
        From `eigengs_dr.raster.lookup.points.in_list_order`: the mean, the inverse
        ``[[p, t], [0, r]]`` of the factor, and the colours times its determinant.
    """
    mean_x, mean_y, a, b, c = shape
    p, r = rcp(a), rcp(c)
    rows = [mean_x, mean_y, p, -b * p * r, r, *[k * p * r for k in color]]
    return in_list_order(splat, rows)


def arranged_values(footprint: list, radius: float) -> Any:
    """Return the same as `widened_values` for the parameters of `arrange`, in fewer operations.

    With ``Sigma' = [[xx, xy], [xy, yy]]`` and its determinant D, the exponent
    ``d^T Sigma'^-1 d`` is ``((yy dx - xy dy)^2 / D + dy^2) / yy``; see
    `eigengs_dr.raster.evaluate.widen` for D.
    """
    fxx, fxy, fyy = kernel_covariance(footprint)
    own = dr.maximum(dr.fma(fxx, fyy, -fxy * fxy), 0)

    def terms(splat: list, x: Any, y: Any) -> list:
        mean_x, mean_y, p, t, r = splat[:NUM_SHAPE_PARAMS]
        dx, dy = x - mean_x, y - mean_y
        xy, yy = dr.fma(t, r, fxy), dr.fma(r, r, fyy)
        across = dr.fma(r * r, fxx, t * dr.fma(t, fyy, -2 * r * fxy))
        pp = p * p
        scale = rsqrt(dr.fma(pp, yy, own + dr.maximum(across, 0)))
        along = dr.fma(yy, dx, -xy * dy) * scale
        w = falloff(dr.fma(along, along, dy * dy) * rcp(yy), radius * radius) * scale
        return [w * c for c in splat[NUM_SHAPE_PARAMS:]]

    return terms

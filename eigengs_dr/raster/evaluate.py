"""The weight of one Gaussian at a point, its derivatives, and its convolution with a footprint.

A Gaussian with the mean mu and the factor ``F = [[a, b], [0, c]]`` of ``Sigma^-1 = F^T F`` has the
weight ``exp(-1/2 |F (x - mu)|^2)`` at x, and the weight 0 if ``|F (x - mu)| > cutoff``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr

from ..backend.arrays import types_of

LN2 = math.log(2)


def exp2_neg(q: Any) -> Any:
    """Return ``2^-q`` for ``0 <= q <= 120``: relative error < 3e-7, half the cost of `drjit.exp2`.

    Split ``q = n - f`` into an integer n and ``|f| <= 1/2``: a polynomial gives ``2^f``, and n is
    subtracted from its exponent bits. Outside the range the result is arbitrary, and callers mask
    it. Double precision uses `drjit.exp2`. Not differentiable: see `falloff`.
    """
    types = types_of(q)
    if types.bits == 64:
        return dr.exp2(-q)
    shifter = 12582912.0  # 1.5 * 2^23: adding it rounds to an integer in the low mantissa bits
    shifted = shifter - q
    f = (shifter - shifted) - q
    power = types.Float(0.0013276471780829455)
    for coefficient in (
        0.009675541332756499,
        0.05550713274151576,
        0.24022119723882304,
        0.6931469670643609,
        1.0,
    ):
        power = dr.fma(power, f, coefficient)
    exponent = dr.reinterpret_array(types.UInt, shifted) << 23
    return dr.reinterpret_array(types.Float, dr.reinterpret_array(types.UInt, power) + exponent)


def falloff(q: Any, limit: float) -> Any:
    """Return ``2^-q`` for ``q <= limit``, else 0; the derivative is ``-ln(2)`` times the value."""
    exact = dr.detach(q)
    value = dr.select(exact <= limit, exp2_neg(exact), 0)
    if not dr.grad_enabled(q):
        return value
    return dr.replace_grad(value, (-LN2 * value) * q)


def weights(shape: list, x: Any, y: Any, tile: tuple[int, int], radius: float) -> list:
    """Evaluate one Gaussian at a block of pixels: ``2^-|F (x - mu)|^2`` in the units of kernels.

    The renderer, its derivatives, the colour solve and the textures (with blocks of one point) all
    evaluate Gaussians here. Cost per point: one `exp2_neg`, a comparison and 2 or 3 operations.

    Parameters
    ----------
    shape : list of 5 Float
        Mean x, mean y, a, b, c; see `eigengs_dr.raster.parameters.KernelParameters`.
    x, y : Float
        First point of the block, in pixels.
    tile : (int, int)
        Width and height of the block; points are 1 pixel apart.
    radius : float
        Cutoff, see `eigengs_dr.raster.parameters.kernel_radius`.

    Returns
    -------
    list of Float
        Weights in [0, 1], row after row.
    """
    limit = radius * radius
    return [falloff(dr.fma(u, u, v * v), limit) for us, v in _rows(shape, x, y, tile) for u in us]


def _rows(shape: list, x: Any, y: Any, tile: tuple[int, int]) -> list[tuple[list, Any]]:
    """Return ``F (x - mu) = (u, v)`` at a block of pixels: a list of u and one v for each row."""
    mean_x, mean_y, a, b, c = shape
    dx, dy = x - mean_x, y - mean_y
    u0, v0 = dr.fma(a, dx, b * dy), c * dy
    rows = []
    for j in range(tile[1]):
        u = dr.fma(b, float(j), u0) if j else u0
        v = dr.fma(c, float(j), v0) if j else v0
        rows.append(([dr.fma(a, float(i), u) if i else u for i in range(tile[0])], v))
    return rows


def weights_vjp(
    shape: list,
    x: Any,
    y: Any,
    tile: tuple[int, int],
    radius: float,
    cotangent: Callable[[int, Any], Any],
) -> list:
    """Return the gradient of ``sum_k g_k w_k`` for ``g_k = cotangent(k, w_k)``.

    With ``e = -2 ln(2) g w``, ``du = e u``, ``dv = e v`` and the offset (i, j) in the block, the
    gradient is ``da = sum du (dx + i)``, ``db = sum du (dy + j)``, ``dc = sum dv (dy + j)`` and
    ``d mu = -(a sum du, b sum du + c sum dv)``. These formulas halve the cost of the adjoint
    compared with Dr.Jit's own derivatives of `weights`.

    Parameters
    ----------
    shape, x, y, tile, radius
        As for `weights`.
    cotangent : callable
        ``cotangent(k, w)`` receives the weight of point k and returns the derivative of the loss
        with respect to this weight.

    Returns
    -------
    list of 5 Float
        Derivatives with respect to mean x, mean y, a, b, c.
    """
    mean_x, mean_y, a, b, c = shape
    limit = radius * radius
    du = dui = duj = dv = dvj = type(mean_x)(0)
    for j, (us, v) in enumerate(_rows(shape, x, y, tile)):
        e_row = u_row = type(mean_x)(0)
        for i, u in enumerate(us):
            w = falloff(dr.fma(u, u, v * v), limit)
            e = w * cotangent(j * tile[0] + i, w)
            e_row = e_row + e
            u_row = dr.fma(e, u, u_row)
            if i:
                dui = dr.fma(e * u, float(i), dui)
        dv_row = e_row * v
        du, dv = du + u_row, dv + dv_row
        if j:
            duj, dvj = dr.fma(u_row, float(j), duj), dr.fma(dv_row, float(j), dvj)
    dx, dy = x - mean_x, y - mean_y
    return [
        k * (-2 * LN2)
        for k in (
            -a * du,
            -dr.fma(b, du, c * dv),
            dr.fma(dx, du, dui),
            dr.fma(dy, du, duj),
            dr.fma(dy, dv, dvj),
        )
    ]


def widen(shape: list, footprint: list) -> tuple[list, Any]:
    """Convolve a Gaussian with a Gaussian footprint whose integral is 1.

    The result has the covariance ``Sigma' = Sigma + Sigma_f``, and the amplitude
    ``sqrt(det Sigma / det Sigma')`` keeps the integral (Heckbert, "Fundamentals of Texture Mapping
    and Image Warping", 1989).

    Parameters
    ----------
    shape : list of 5 Float
        As for `weights`.
    footprint : list of 3 Float
        xx, xy, yy of ``Sigma_f``, from `eigengs_dr.raster.parameters.kernel_covariance`.

    Returns
    -------
    shape : list of 5 Float
        The mean and the factor of ``Sigma'``.
    amplitude : Float
        In (0, 1].
    """
    mean_x, mean_y, a, b, c = shape
    fxx, fxy, fyy = footprint
    ia, ic = dr.rcp(a), dr.rcp(c)
    t = -b * ia * ic  # F^-1 = [[1/a, t], [0, 1/c]]
    xy = dr.fma(t, ic, fxy)
    yy = dr.fma(ic, ic, fyy)
    # det(S + F) = det S + tr(adj(S) F) + det F is a sum of squares. The plain formula xx yy - xy^2
    # loses all digits for very elongated Gaussians.
    across = dr.fma(ic * ic, fxx, t * dr.fma(t, fyy, -2 * ic * fxy))
    whole = ia * ic
    added = dr.maximum(dr.fma(fxx, fyy, -fxy * fxy), 0) + dr.maximum(across, 0)
    scale = dr.rsqrt(dr.fma(whole, whole, dr.fma(ia * ia, fyy, added)))
    new_c = dr.rsqrt(yy)
    scaled = new_c * scale
    return [mean_x, mean_y, yy * scaled, -xy * scaled, new_c], whole * scale

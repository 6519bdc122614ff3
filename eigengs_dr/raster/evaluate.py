"""The weight of one Gaussian at a point, its derivatives, and its convolution with a footprint.

A Gaussian with the mean mu and the factor ``F = [[a, b], [0, c]]`` of ``Sigma^-1 = F^T F`` has the
weight ``exp(-1/2 |F (x - mu)|^2)`` at x, or 0 if ``|F (x - mu)| > cutoff``.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import drjit as dr

from ..backend.arrays import rcp, rsqrt, types_of
from ..backend.types import Bool, Float, FloatLike

LN2 = math.log(2)

MAX_PRODUCT_EXPONENT = 122.0
"""Largest exponent, to the base 2, in the products of `weights`. A Gaussian with a larger one is
steep, see `is_steep`."""


def exp2_neg(q: Float) -> Float:
    """Return ``2^-q`` for ``-126 <= q <= 126``: relative error < 3e-7, on cuda < 5e-7.

    On llvm in single precision this takes half the time of `drjit.exp2`: ``q = n - f`` is split
    into an integer n and ``|f| <= 1/2``; a polynomial gives ``2^f``, and n is subtracted from its
    exponent bits. Outside of the range the result is arbitrary, and callers mask it. Double
    precision and GPUs, where it is one instruction, use `drjit.exp2`. Not differentiable: see
    `falloff`.
    """
    types = types_of(q)
    if types.bits == 64 or types.backend != "llvm":
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


def falloff(q: Float, limit: float | None = None) -> Float:
    """Return ``2^-q``, but 0 beyond a limit; the derivative is ``-ln(2)`` times the value."""
    exact = dr.detach(q)
    value = exp2_neg(exact)
    if limit is not None:
        value = dr.select(exact <= limit, value, 0)
    if not dr.grad_enabled(q):
        return value
    return dr.replace_grad(value, (-LN2 * value) * q)


def weights(
    shape: list, x: Float, y: Float, tile: tuple[int, int], radius: float, exact_exp: bool = True
) -> list:
    """Evaluate one Gaussian at a block of pixels: ``2^-|F (x - mu)|^2`` in the units of kernels.

    The renderer, its derivatives, the colour solve and the textures (with blocks of one point) all
    use this function.

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
    exact_exp : bool, optional
        Whether to evaluate an exponential at every point. False is faster: products continue one
        exponential per row, with a relative error of about 2e-6, and 1e-5 for the narrowest
        Gaussians. This requires a width of 4 and a Gaussian for which `is_steep` is false, and
        Dr.Jit cannot differentiate it.

    Returns
    -------
    list of Float
        Weights in [0, 1], row after row; on cuda at most 5e-7 above 1, the error of its
        exponential.
    """
    return [w for row in _rows(shape, x, y, tile, radius, exact_exp) for w in row[0]]


def _rows(
    shape: list, x: Float, y: Float, tile: tuple[int, int], radius: float, exact_exp: bool
) -> list[tuple[list, Float, Float]]:
    """Return for each row of a block its weights, and (u, v) = F (x - mu) at column `_column`.

    A step to the right changes u by a, and a step down changes (u, v) by (b, c).
    """
    mean_x, mean_y, a, b, c = shape
    dx, dy = x + float(_column(tile)) - mean_x, y - mean_y
    u0, v0 = dr.fma(a, dx, b * dy), c * dy
    points = [(dr.fma(b, float(j), u0), dr.fma(c, float(j), v0)) for j in range(tile[1])]
    points[0] = (u0, v0)
    if not exact_exp:
        return _chained(a, b, points, radius)
    limit, steps = radius * radius, [float(i - _column(tile)) for i in range(tile[0])]
    rows = []
    for u, v in points:
        us = [dr.fma(a, i, u) if i else u for i in steps]
        rows.append(([falloff(dr.fma(t, t, v * v), limit) for t in us], u, v))
    return rows


def _column(tile: tuple[int, int]) -> int:
    """Return the column at which a row of a block starts: the second of 4 bounds the products."""
    return min(1, tile[0] - 1)


def _chained(a: Float, b: Float, points: list, radius: float) -> list[tuple[list, Float, Float]]:
    """Return the rows of `_rows`, of 4 pixels, by products from the weight w_1 of the second pixel.

    With (u, v) at that pixel, ``w_2 = w_1 M``, ``w_3 = w_2 M K`` and ``w_0 = w_1 K / M``, where
    ``M = 2^-(2 a u + a^2)`` and ``K = 2^-2a^2``. The next row has ``M 2^-2ab``. Unless `is_steep`
    is true, all factors stay in the range of floats.
    """
    largest, least = 126.0, 2.0 ** (-radius * radius)
    start = (len(points) - 1) // 2  # the ratios start here, where their exponents are smallest
    exponent = dr.fma(2 * a, points[start][0], a * a)
    ratio = exp2_neg(dr.clip(exponent, -largest, largest))
    bend = exp2_neg(dr.minimum(2 * a * a, largest))
    down = exp2_neg(dr.clip(2 * a * b, -largest, largest))
    up = rcp(down)
    rows = []
    for (u, v), right, left in zip(
        points,
        _powers(ratio, up, down, start, len(points)),
        _powers(rcp(ratio), down, up, start, len(points)),
        strict=True,
    ):
        q = dr.fma(u, u, v * v)
        w1 = dr.select(q <= largest, exp2_neg(q), 0)
        w2 = w1 * right
        ws = (w1 * (left * bend), w1, w2, w2 * (right * bend))
        # A factor that left the range gives NaN here, and a comparison with NaN is false.
        rows.append(([dr.select(w >= least, w, 0) for w in ws], u, v))
    return rows


def _powers(value: Float, up: Float, down: Float, start: int, count: int) -> list:
    """Return `count` values: `value` at `start`, multiplied by `up` before and `down` after it."""
    values = [value]
    for _ in range(start):
        values.insert(0, values[0] * up)
    while len(values) < count:
        values.append(values[-1] * down)
    return values


def is_steep(shape: list, radius: float) -> Bool:
    """Return for each Gaussian whether products could leave the range of floats in `weights`.

    Next to a pixel inside the ellipse, ``|u| <= radius + 2 a`` at the second pixel of the row, and
    ``|u| <= radius + 2 a + 2 |b|`` in the row where the ratios start. The exponents of the weight
    there, ``u^2 + v^2``, and of the ratio, ``2 a u + a^2``, must stay below 126;
    `MAX_PRODUCT_EXPONENT` leaves a margin for Gaussians that shrink until the next test. Gaussians
    within their bounds, see `eigengs_dr.gaussian.gaussians`, reach 121.2 at a cutoff of 3: a fit
    has no steep Gaussian.

    Parameters
    ----------
    shape : list of 5 Float, shape (N,)
        As for `weights`.
    radius : float
        As for `weights`.

    Returns
    -------
    Bool, shape (N,)
        True for standard deviations below about 0.2 pixels at a cutoff of 3.
    """
    _, _, a, b, _ = shape
    reach = dr.fma(2.0, a, radius)
    ratio = dr.fma(2 * a, reach + 2 * dr.abs(b), a * a)
    return ~((reach * reach <= MAX_PRODUCT_EXPONENT) & (ratio <= MAX_PRODUCT_EXPONENT))


def weights_vjp(
    shape: list,
    x: Float,
    y: Float,
    tile: tuple[int, int],
    radius: float,
    cotangent: Callable[[int, Float], FloatLike],
    exact_exp: bool = True,
) -> list:
    """Return the gradient of ``sum_k g_k w_k`` for ``g_k = cotangent(k, w_k)``.

    With ``e = -2 ln(2) g w``, ``du = e u``, ``dv = e v`` and the offset (i, j) in the block, the
    gradient is ``da = sum du (dx + i)``, ``db = sum du (dy + j)``, ``dc = sum dv (dy + j)`` and
    ``d mu = -(a sum du, b sum du + c sum dv)``. A row needs only the moments ``sum e``,
    ``sum e i`` and ``sum e i^2``, because u is linear in i.

    Parameters
    ----------
    shape, x, y, tile, radius, exact_exp
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
    steps = [float(i - _column(tile)) for i in range(tile[0])]
    du = dui = duj = dv = dvj = type(mean_x)(0)
    for j, (ws, u, v) in enumerate(_rows(shape, x, y, tile, radius, exact_exp)):
        e = [w * cotangent(j * tile[0] + i, w) for i, w in enumerate(ws)]
        e0, e1, e2 = (
            _moment(e, [1.0] * len(e)),
            _moment(e, steps),
            _moment(e, [i * i for i in steps]),
        )
        u_row, v_row = dr.fma(u, e0, a * e1), v * e0
        du, dv = du + u_row, dv + v_row
        dui = dui + dr.fma(u, e1, a * e2)
        if j:
            duj, dvj = dr.fma(u_row, float(j), duj), dr.fma(v_row, float(j), dvj)
    dx, dy = x + float(_column(tile)) - mean_x, y - mean_y
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


def _moment(values: list, factors: list[float]) -> Float:
    """Return the sum of values times literal factors; factors 0 and 1 need no multiplication."""
    total = type(values[0])(0)
    for value, factor in zip(values, factors, strict=True):
        if factor == 1:
            total = total + value
        elif factor:
            total = dr.fma(value, factor, total)
    return total


def widen(shape: list, footprint: list) -> tuple[list, Float]:
    """Convolve a Gaussian with a Gaussian footprint whose integral is 1.

    The result has the covariance ``Sigma' = Sigma + Sigma_f``, and the amplitude ``sqrt(det Sigma /
    det Sigma')`` preserves the integral (Heckbert, "Fundamentals of Texture Mapping and Image
    Warping", 1989).

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
    mean_x, mean_y, p, t, r = inverted(shape)
    widened, scale = widen_inverted([mean_x, mean_y, p, t, r], footprint)
    return widened, p * r * scale


def inverted(shape: list) -> list:
    """Return the mean, and p, t, r of the inverse ``[[p, t], [0, r]]`` of the factor."""
    mean_x, mean_y, a, b, c = shape
    p, r = (rcp(dr.select(dr.abs(k) < FLATTEST, FLATTEST, dr.minimum(k, STEEPEST))) for k in (a, c))
    return [mean_x, mean_y, p, dr.clip(-b * p * r, -MOST_SHEARED, MOST_SHEARED), r]


FLATTEST, STEEPEST, MOST_SHEARED = 1e-8, 1e8, 1e12
"""Bounds of a factor, and of t of its inverse, in pixels. Beyond, products of four leave the range
of floats, and a Gaussian is constant over any image, or between all of its points."""


def widen_inverted(shape: list, footprint: list) -> tuple[list, Float]:
    """Convolve as `widen` does, a shape from `inverted`; the amplitude lacks a factor p r."""
    mean_x, mean_y, p, t, r = shape
    fxx, fxy, fyy = footprint
    xy = dr.fma(t, r, fxy)
    yy = dr.fma(r, r, fyy)
    # det(S + F) = det S + tr(adj(S) F) + det F is a sum of squares. The plain formula xx yy - xy^2
    # loses all digits for very elongated Gaussians.
    across = dr.fma(r * r, fxx, t * dr.fma(t, fyy, -2 * r * fxy))
    root_det = p * r  # sqrt(det S)
    added = dr.maximum(dr.fma(fxx, fyy, -fxy * fxy), 0) + dr.maximum(across, 0)
    scale = rsqrt(dr.fma(root_det, root_det, dr.fma(p * p, fyy, added)))
    new_c = rsqrt(yy)
    scaled = new_c * scale
    return [mean_x, mean_y, yy * scaled, -xy * scaled, new_c], scale

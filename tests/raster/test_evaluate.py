"""One splat at a block of points: values, both derivatives; splats that a footprint widens."""

import math

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from _helpers.footprints import matrices
from _helpers.sets import covariances, few, random_scene, upload
from eigengs_dr.backend.arrays import types_in, types_of
from eigengs_dr.backend.selection import select
from eigengs_dr.raster.evaluate import (
    exp2_neg,
    falloff,
    is_steep,
    weights,
    weights_vjp,
    widen,
)
from eigengs_dr.raster.parameters import EXP2_SCALE, NUM_SHAPE_PARAMS, kernel_radius
from eigengs_dr.raster.render import decode_parameters

TILE = (4, 3)
CUTOFF = 3.0
RADIUS = kernel_radius(CUTOFF)
COUNT = 256


def precision(types, single, double):
    return single if types.bits == 32 else double


def draw(seed=0):
    """Random parameters (5, N) of splats near the block that starts at (x, y), all float32."""
    rng = np.random.default_rng(seed)
    x, y = np.floor(rng.uniform(0, 40, (2, COUNT))) + 0.5
    mean = np.stack([x, y]) + rng.uniform(-5, 8, (2, COUNT))
    a, c = np.exp(rng.uniform(math.log(0.1), math.log(2), (2, COUNT)))
    shape = np.stack([*mean, a, rng.uniform(-1, 1, COUNT), c])
    return [v.astype(np.float32).astype(np.float64) for v in (shape, x, y)]


def squared_distance(shape, x, y):
    """``|F (x - mean)|^2`` at the points of the block, shape (points, N)."""
    mx, my, a, b, c = shape
    j, i = np.indices(TILE[::-1]).reshape(2, -1, 1)
    dx, dy = x + i - mx, y + j - my
    return (a * dx + b * dy) ** 2 + (c * dy) ** 2


def scaled(types, shape):
    """Parameters as kernels take them: the factor in units of `EXP2_SCALE`."""
    return [v * EXP2_SCALE if k > 1 else v for k, v in enumerate(upload(types, *shape))]


def error_of_exp2_neg(types):
    rng = np.random.default_rng(0)
    halves, small = np.arange(0, 120.25, 0.25), 2.0 ** -np.arange(99)
    q = np.concatenate([halves, small, rng.uniform(0, 120, 200_000)])
    q = q.astype(np.float32).astype(np.float64)
    value = exp2_neg(types.Float(q)).numpy().astype(np.float64)
    return np.abs(value / np.exp2(-q) - 1).max()


def test_exp2_neg(types):
    single = 2.5e-7 if types.backend == "llvm" else EXP2_ERROR["cuda"]
    assert error_of_exp2_neg(types) < precision(types, single, 1e-15)


EXP2_ERROR = {"llvm": 3e-7, "cuda": 5e-7}
"""As documented; the instruction of a GPU may be off by 2 last bits, also above 1."""


def test_weights_are_at_most_one(backend):
    types = types_in(select(backend))
    q = np.concatenate([np.linspace(0, 2, 10_001), 2.0 ** -np.arange(99)])
    above = 0 if backend == "llvm" else EXP2_ERROR[backend]
    assert exp2_neg(types.Float(q)).numpy().max() <= 1 + above


def test_falloff_ends_at_the_limit(types):
    q = types.Float([0, 6, np.nextafter(np.float32(6), np.float32(7)), 1e9, np.inf, np.nan])
    value = falloff(q, 6.0).numpy()
    assert value[:2] == pytest.approx([1, 2**-6], rel=2e-7)
    assert not value[2:].any()


@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_derivative_of_falloff(types, mode):
    points = np.linspace(0, 12, 200)
    q = types.Float(points)
    dr.enable_grad(q)
    value = falloff(q, 6.0)
    assert dr.allclose(dr.detach(value), falloff(dr.detach(q), 6.0), 0, 0)
    if mode == "reverse":
        dr.backward(value)
        slope = dr.grad(q).numpy()
    else:
        dr.forward(q)
        slope = dr.grad(value).numpy()
    exact = np.where(points <= 6, -math.log(2) * np.exp2(-points), 0)
    np.testing.assert_allclose(slope, exact, rtol=precision(types, 1e-6, 1e-13), atol=0)


both_ways = pytest.mark.parametrize("steep", [True, False], ids=["exponentials", "products"])


@both_ways
def test_weights(types, steep):
    shape, x, y = draw()
    found = weights(scaled(types, shape), *upload(types, x, y), TILE, RADIUS, steep)
    assert len(found) == TILE[0] * TILE[1]
    q = squared_distance(shape, x, y)
    exact = np.where(q <= CUTOFF**2, np.exp(-0.5 * q), 0)
    clear = np.abs(q / CUTOFF**2 - 1) > 1e-4  # rounding decides nearer to the edge
    error = np.abs(np.stack([w.numpy() for w in found]) - exact)[clear]
    assert clear.mean() > 0.99
    assert ((exact > 0) & (exact < 1)).mean() > 0.1
    assert error.max() < precision(types, 3e-6, 1e-13)


@pytest.mark.parametrize("rows", [1, 2, 4])
@pytest.mark.parametrize("cutoff", [2.0, 3.0, 3.5])
def test_products_are_exact_for_all_but_steep_gaussians(types, rows, cutoff):
    """Sizes from 0.1 to 100 pixels, all directions, near and far: as close as exponentials."""
    rng = np.random.default_rng(rows)
    count = 4000
    x = y = np.full(count, 20.5)
    mean = 22 + rng.uniform(-1, 1, (2, count)) * np.exp(rng.uniform(0, 4, count))
    a, c = np.exp(rng.uniform(math.log(0.01), math.log(10), (2, count)))
    b = rng.choice([-1, 1], count) * np.exp(rng.uniform(math.log(0.01), math.log(10), count))
    shape = np.stack([*mean, a, b, c]).astype(np.float32).astype(float)
    radius = kernel_radius(cutoff)
    kernel, corner = scaled(types, shape), upload(types, x, y)
    found, expected = (
        np.stack([w.numpy() for w in weights(kernel, *corner, (4, rows), radius, steep)])
        for steep in (False, True)
    )
    smooth = ~is_steep(kernel, radius).numpy()
    assert 0.3 < smooth.mean() < 0.95
    # At the edge of the ellipse, rounding decides whether a pixel is inside.
    edge = math.exp(-0.5 * cutoff**2) * (1 + 1e-4)
    clear = (found > edge) | (expected > edge) | (found + expected == 0)
    error = np.abs(found - expected)[:, smooth][clear[:, smooth]]
    assert ((expected[:, smooth] > edge).mean(axis=1) > 0.05).all()
    assert np.isfinite(found[:, smooth]).all()
    assert error.max() < precision(types, 2e-5, 1e-13)


@both_ways
@pytest.mark.parametrize("position", range(5))
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_weights_are_never_nan(types, position, value, steep):
    shape = scaled(types, [[8.0], [8.0], [0.5], [0.1], [0.5]])
    shape[position] = types.Float(value)
    found = weights(shape, types.Float(6.5), types.Float(6.5), TILE, RADIUS, steep)
    assert not any(w.numpy().any() for w in found)


def pull_with(upstream):
    return lambda k, w: upstream[k]


@both_ways
def test_pullback_is_the_derivative_of_weights(types, steep):
    shape, x, y = draw()
    rng = np.random.default_rng(1)
    upstream = upload(types, *rng.normal(size=(TILE[0] * TILE[1], COUNT)))
    parameters, x, y = scaled(types, shape), *upload(types, x, y)
    by_hand = weights_vjp(parameters, x, y, TILE, RADIUS, pull_with(upstream), steep)
    dr.enable_grad(parameters)
    total = sum(
        g * w for g, w in zip(upstream, weights(parameters, x, y, TILE, RADIUS), strict=True)
    )
    dr.backward(total)
    for ours, theirs in zip(by_hand, dr.grad(parameters), strict=True):
        size = np.abs(theirs.numpy()).max()
        error = np.abs(ours.numpy() - theirs.numpy()).max()
        assert error <= precision(types, 3e-6, 1e-13) * size


class TestWiden:
    @few
    @given(seed=st.integers(0, 1000))
    def test_covariances_add_and_the_integral_stays(self, backend, seed):
        rng = np.random.default_rng(seed)
        scene = random_scene(seed)
        spread = covariances(rng.uniform(0, 30, (1, 2)), rng.uniform(0, np.pi, 1))[0]
        p = decode_parameters(scene.on(backend, bits=64))
        rows = [*p.shape, *p.color]
        Float = types_of(rows[0]).Float
        footprint = [Float(spread[k] / EXP2_SCALE**2) for k in ((0, 0), (0, 1), (1, 1))]
        (_, _, a, b, c), amplitude = widen(rows[:NUM_SHAPE_PARAMS], footprint)
        a, b, c = (np.array(v) / EXP2_SCALE for v in (a, b, c))
        before, after = matrices(*scene.factor.T), matrices(a, b, c)
        np.testing.assert_allclose(after, before + spread, rtol=1e-9, atol=1e-9)
        integrals_before, integrals_after = (np.sqrt(np.linalg.det(m)) for m in (before, after))
        np.testing.assert_allclose(np.array(amplitude) * integrals_after, integrals_before)

    @pytest.mark.parametrize("spread", [(0, 0, 0), (0.05, 0.01, 0.08), (1, 0.3, 2)])
    def test_needles_keep_their_digits(self, backend, spread):
        """Lengths of up to 1,000 times the width, at any angle, in single precision."""
        rng = np.random.default_rng(0)
        a, c = np.exp(rng.uniform(np.log(1 / 2048), np.log(4), (2, 10_000)))
        b = rng.uniform(-4, 4, 10_000)
        shape = [np.zeros(10_000), np.zeros(10_000), a, b, c]
        found = {}
        for bits in ("", "64"):
            Float = getattr(select(backend), "Float" + bits)
            rows = [Float(np.asarray(v, np.float32)) for v in shape]
            (*_, a1, b1, c1), amplitude = widen(rows, [Float(v) for v in spread])
            found[bits] = [np.array(v) for v in (a1, b1, c1, amplitude)]
        for single, double in zip(found[""], found["64"], strict=True):
            np.testing.assert_allclose(single, double, rtol=1e-3, atol=1e-6)

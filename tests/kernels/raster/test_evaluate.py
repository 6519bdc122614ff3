"""One splat at a block of points by approximations, and splats that a footprint widens."""

import math

import drjit as dr
import numpy as np
import pytest

from _helpers.arrays import upload_rows
from eigengs_dr.backend.selection import select
from eigengs_dr.raster.evaluate import exp2_neg, is_steep, weights, widen
from eigengs_dr.raster.parameters import EXP2_SCALE, kernel_radius


def test_exp2_neg(types):
    """As documented; the instruction of a GPU may be off by 2 last bits."""
    rng = np.random.default_rng(0)
    halves, small = np.arange(0, 120.25, 0.25), 2.0 ** -np.arange(99)
    q = np.concatenate([halves, small, rng.uniform(0, 120, 200_000)])
    q = q.astype(np.float32).astype(np.float64)
    found = exp2_neg(types.Float(q)).numpy().astype(np.float64)
    single, above = (2.5e-7, 0) if types.backend == "llvm" else (5e-7, 5e-7)
    assert np.abs(found / np.exp2(-q) - 1).max() < (single if types.bits == 32 else 1e-15)
    assert found.max() <= 1 + above


@pytest.mark.parametrize(("rows", "cutoff"), [(1, 2.0), (4, 3.5)])
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
    shape[2:] *= EXP2_SCALE  # in the units of kernels
    kernel, corner = (upload_rows(types.Float, rows) for rows in (shape, (x, y)))
    both = [weights(kernel, *corner, (4, rows), radius, steep) for steep in (False, True)]
    dr.eval(both)
    found, expected = (np.stack([w.numpy() for w in some]) for some in both)
    smooth = ~is_steep(kernel, radius).numpy()
    assert 0.3 < smooth.mean() < 0.95
    # At the edge of the ellipse, rounding decides whether a pixel is inside.
    edge = math.exp(-0.5 * cutoff**2) * (1 + 1e-4)
    clear = (found > edge) | (expected > edge) | (found + expected == 0)
    error = np.abs(found - expected)[:, smooth][clear[:, smooth]]
    assert ((expected[:, smooth] > edge).mean(axis=1) > 0.05).all()
    assert np.isfinite(found[:, smooth]).all()
    assert error.max() < (2e-5 if types.bits == 32 else 1e-13)


@pytest.mark.parametrize("spread", [(0, 0, 0), (0.05, 0.01, 0.08), (1, 0.3, 2)])
def test_widened_needles_keep_their_digits(backend, spread):
    """Lengths of up to 1,000 times the width, at any angle, in single precision."""
    rng = np.random.default_rng(0)
    a, c = np.exp(rng.uniform(np.log(1 / 2048), np.log(4), (2, 10_000)))
    b = rng.uniform(-4, 4, 10_000)
    shape = [np.zeros(10_000), np.zeros(10_000), a, b, c]
    found = {}
    for bits in ("", "64"):
        Float = getattr(select(backend), "Float" + bits)
        rows = [Float(np.asarray(v, np.float32)) for v in shape]
        (*_, a1, b1, c1), amplitude = widen(rows, [dr.opaque(Float, v) for v in spread])
        found[bits] = [np.array(v) for v in (a1, b1, c1, amplitude)]
    for single, double in zip(found[""], found["64"], strict=True):
        np.testing.assert_allclose(single, double, rtol=1e-3, atol=1e-6)

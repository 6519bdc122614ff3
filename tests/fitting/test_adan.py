"""Adan, against its algorithm by hand."""

import drjit as dr
import numpy as np
import pytest

from _helpers.optimizers import minimize
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.parameterization import Adan


def adan_by_hand(start, gradient, rate, steps, betas=(0.98, 0.92, 0.99), epsilon=1e-8):
    """Algorithm 1 of the paper, its betas subtracted from one as in its authors' code."""
    x = np.array(start, np.float64)
    m, v, n = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
    last = None
    path = []
    for t in range(1, steps + 1):
        g = gradient(x)
        d = np.zeros_like(g) if last is None else g - last
        m = betas[0] * m + (1 - betas[0]) * g
        v = betas[1] * v + (1 - betas[1]) * d
        n = betas[2] * n + (1 - betas[2]) * (g + betas[1] * d) ** 2
        m_hat, v_hat, n_hat = (
            average / (1 - beta**t) for average, beta in zip((m, v, n), betas, strict=True)
        )
        x = x - rate * (m_hat + betas[1] * v_hat) / (np.sqrt(n_hat) + epsilon)
        last = g
        path.append(x)
    return np.array(path)


@pytest.mark.parametrize(("bits", "rtol"), [(32, 1e-4), (64, 1e-10)])
@pytest.mark.parametrize("betas", [(0.98, 0.92, 0.99), (0.9, 0.5, 0.95)])
def test_adan(backend, bits, rtol, betas):
    module = select(backend)
    Float = module.Float64 if bits == 64 else module.Float
    start = np.array([1.0, -2, 0.5])
    path = minimize(Adan(betas), Float(start), lambda x: x * x * x + 3 * dr.cos(x), 0.1, 30)
    expected = adan_by_hand(start, lambda x: x**3 + 3 * np.cos(x), 0.1, 30, betas)
    np.testing.assert_allclose(path, expected, rtol=0, atol=rtol * np.ptp(expected))


def test_adan_takes_a_full_first_step(backend):
    """m / sqrt(n) is the sign of the first gradient, whatever its size."""
    Float = select(backend).Float
    [moved] = minimize(Adan(), Float(0, 0, 0), lambda x: Float(1e-3, -1, 1e3), 0.25, 1)
    np.testing.assert_allclose(moved, [-0.25, 0.25, -0.25], rtol=1e-4)


def test_adan_rests_where_nothing_changes(backend):
    Float = select(backend).Float
    path = minimize(Adan(), Float(1, 2), lambda x: Float(0, 0), 0.1, 3)
    np.testing.assert_array_equal(path, np.tile([1, 2], (3, 1)))


@pytest.mark.parametrize("betas", [(1.0, 0.9, 0.9), (0.9, -0.1, 0.9), (0.9, 0.9, np.nan)])
def test_adan_refuses_betas(betas):
    with pytest.raises(ValueError, match="betas"):
        Adan(betas=betas)

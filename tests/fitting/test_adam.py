"""Adam, against its algorithm by hand."""

import drjit as dr
import numpy as np
import pytest

from _helpers.optimizers import minimize
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.parameterization import Adam


def adam_by_hand(start, gradient, rate, steps, betas, epsilon):
    """Algorithm 1 of the paper, with its epsilon after the debiasing of the second moment."""
    x = np.array(start, np.float64)
    m, v = np.zeros_like(x), np.zeros_like(x)
    path = []
    for t in range(1, steps + 1):
        g = gradient(x)
        m = betas[0] * m + (1 - betas[0]) * g
        v = betas[1] * v + (1 - betas[1]) * g**2
        scale = rate * np.sqrt(1 - betas[1] ** t) / (1 - betas[0] ** t)
        x = x - scale * m / (np.sqrt(v) + epsilon)
        path.append(x)
    return np.array(path)


@pytest.mark.parametrize(("bits", "rtol"), [(32, 1e-4), (64, 1e-10)])
@pytest.mark.parametrize("betas", [(0.9, 0.9), (0.9, 0.99), (0.0, 0.5)])
def test_adam(backend, bits, rtol, betas):
    module = select(backend)
    Float = module.Float64 if bits == 64 else module.Float
    start = np.array([1.0, -2, 0.5])
    optimizer = Adam(*betas, epsilon=1e-12)
    path = minimize(optimizer, Float(start), lambda x: x * x * x + 3 * dr.cos(x), 0.1, 30)
    expected = adam_by_hand(start, lambda x: x**3 + 3 * np.cos(x), 0.1, 30, betas, 1e-12)
    np.testing.assert_allclose(path, expected, rtol=0, atol=rtol * np.ptp(expected))


def test_no_step_is_longer_than_the_rate(backend):
    """With equal betas: the bound behind the margin of the tile lists."""
    Float = select(backend).Float
    generator = np.random.default_rng(0)
    noise = iter(generator.standard_cauchy((200, 50)).astype(np.float32))
    optimizer = Adam(0.9, 0.9, 1e-12)
    path = minimize(optimizer, Float(np.zeros(50)), lambda x: Float(next(noise)), 0.1, 200)
    assert np.abs(np.diff(path, axis=0)).max() <= 0.1 * (1 + 1e-5)


def test_adam_after_many_steps(backend):
    """Powers of the betas leave the range of floats; the debiasing is then 1."""
    Float = select(backend).Float
    optimizer, value = Adam(0.9, 0.9, 1e-12), Float(1, -2)
    moments = optimizer.start(value)
    for t in (1000, 6735, 1_000_000):
        moved, _ = optimizer.step(value, Float(3, -4), moments, Float(0.1), Float(t))
        # Averages that start at 0 hold a share of 0.1 of a new gradient, and its square root.
        expected = np.array([1, -2]) - 0.1 * np.sqrt(0.1) * np.array([1, -1])
        np.testing.assert_allclose(moved.numpy(), expected, rtol=1e-5)


@pytest.mark.parametrize("betas", [(1.0, 0.9), (0.9, -0.1), (np.nan, 0.9)])
def test_adam_refuses_betas(betas):
    with pytest.raises(ValueError, match="betas"):
        Adam(*betas)

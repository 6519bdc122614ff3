"""Adan, against its algorithm by hand."""

import drjit as dr
import drjit.opt
import numpy as np
import pytest

from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.optimizers.adan import Adan


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
    """Two parameters of one optimiser, each with its own rate, on curved losses."""
    module = select(backend)
    Float = module.Float64 if bits == 64 else module.Float
    starts = {"x": np.array([1.0, -2, 0.5]), "y": np.linspace(-1, 1, 7)}
    rates, curvature = {"x": 0.1, "y": 0.02}, {"x": 3.0, "y": 0.5}
    optimizer = Adan(1.0, {k: Float(v) for k, v in starts.items()}, betas=betas)
    optimizer.set_learning_rate(rates)
    paths = {"x": [], "y": []}
    for _ in range(30):
        loss = sum(
            dr.sum(0.25 * dr.square(dr.square(optimizer[k])) + curvature[k] * dr.sin(optimizer[k]))
            for k in starts
        )
        dr.backward(loss)
        optimizer.step()
        for k, path in paths.items():
            path.append(optimizer[k].numpy())
    for k, start in starts.items():
        expected = adan_by_hand(
            start, lambda x, k=k: x**3 + curvature[k] * np.cos(x), rates[k], 30, betas
        )
        scale = np.abs(expected - start).max()
        np.testing.assert_allclose(paths[k], expected, rtol=0, atol=rtol * scale)


def test_adan_takes_a_full_first_step(backend):
    """m / sqrt(n) is the sign of the first gradient, whatever its size."""
    Float = select(backend).Float
    optimizer = Adan(0.25, {"x": Float(0, 0, 0)})
    dr.backward(optimizer["x"] * Float(1e-3, -1, 1e3))
    optimizer.step()
    np.testing.assert_allclose(optimizer["x"].numpy(), [-0.25, 0.25, -0.25], rtol=1e-4)


def test_adan_rests_where_nothing_changes(backend):
    Float = select(backend).Float
    optimizer = Adan(0.25, {"x": Float(1, 2)})
    for _ in range(3):
        dr.backward(optimizer["x"] * Float(0, 0))
        optimizer.step()
    np.testing.assert_array_equal(optimizer["x"].numpy(), [1, 2])


def test_adan_starts_again_after_a_reset(backend):
    Float = select(backend).Float
    optimizer = Adan(0.1, {"x": Float(1, 2)})

    def first_step():
        dr.backward(dr.sum(dr.square(optimizer["x"])))
        optimizer.step()
        return optimizer["x"].numpy()

    before = first_step()
    first_step()
    optimizer["x"] = Float(1, 2)
    optimizer.reset("x")
    np.testing.assert_array_equal(first_step(), before)


@pytest.mark.parametrize("betas", [(1.0, 0.9, 0.9), (0.9, -0.1, 0.9), (0.9, 0.9, np.nan)])
def test_adan_refuses_betas(betas):
    with pytest.raises(ValueError, match="betas"):
        Adan(0.1, betas=betas)

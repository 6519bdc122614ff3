"""The optimisers, against their algorithms by hand."""

import drjit as dr
import numpy as np
import pytest

from eigengs_dr.backend.arrays import types_in, upload
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.coarse import Agreeing
from eigengs_dr.fitting.state import Adam
from eigengs_dr.paper.adan import Adan


def minimize(optimizer, value, gradient, rate, steps):
    """Values after each step, shape (steps, n), for ``gradient(value)`` on the device."""
    Float, moments, path = type(value), optimizer.start(value), []
    for t in range(1, steps + 1):
        numbers = dr.opaque(Float, rate), dr.opaque(Float, t)
        value, moments = optimizer.step(value, gradient(value), moments, *numbers)
        dr.eval(value, moments)
        path.append(value.numpy().copy())
    return np.array(path)


def adam_by_hand(x, gradient, rate, steps, betas, epsilon=1e-12):
    """Algorithm 1 of the paper, with its epsilon after the debiasing of the second moment."""
    m, v, path = np.zeros_like(x), np.zeros_like(x), []
    for t in range(1, steps + 1):
        g = gradient(x)
        m = betas[0] * m + (1 - betas[0]) * g
        v = betas[1] * v + (1 - betas[1]) * g**2
        scale = rate * np.sqrt(1 - betas[1] ** t) / (1 - betas[0] ** t)
        x = x - scale * m / (np.sqrt(v) + epsilon)
        path.append(x)
    return np.array(path)


def adan_by_hand(x, gradient, rate, steps, betas, epsilon=1e-8):
    """Algorithm 1 of the paper, its betas subtracted from one as in its authors' code."""
    m, v, n = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
    last, path = gradient(x), []
    for t in range(1, steps + 1):
        g = gradient(x)
        m = betas[0] * m + (1 - betas[0]) * g
        v = betas[1] * v + (1 - betas[1]) * (g - last)
        n = betas[2] * n + (1 - betas[2]) * (g + betas[1] * (g - last)) ** 2
        m_hat, v_hat, n_hat = (
            average / (1 - beta**t) for average, beta in zip((m, v, n), betas, strict=True)
        )
        x = x - rate * (m_hat + betas[1] * v_hat) / (np.sqrt(n_hat) + epsilon)
        last = g
        path.append(x)
    return np.array(path)


def agreeing_by_hand(x, gradient, rate, steps, betas, epsilon=1e-8):
    """The equations of its docstring, at its default settings."""
    m, v, average, r, path = np.zeros_like(x), np.zeros_like(x), x, 0.2, []
    for t in range(1, steps + 1):
        g, way = gradient(x), x - average
        m = betas[0] * m + (1 - betas[0]) * g
        v = betas[1] * v + (1 - betas[1]) * g**2
        if way.any():
            r = np.clip(
                r * np.exp(-0.2 * g @ way / np.linalg.norm(g) / np.linalg.norm(way)), 0.02, 1
            )
        scale = rate * r * np.sqrt(1 - betas[1] ** t) / (1 - betas[0] ** t)
        average = 0.9 * average + 0.1 * x
        x = x - scale * m / (np.sqrt(v + 0.05 * v.mean()) + epsilon)
        path.append(x)
    return np.array(path)


@pytest.mark.parametrize(
    ("optimizer", "by_hand", "betas"),
    [
        (Adam(0.9, 0.9, 1e-12), adam_by_hand, (0.9, 0.9)),
        (Adam(0.9, 0.99, 1e-12), adam_by_hand, (0.9, 0.99)),
        (Adam(0.0, 0.5, 1e-12), adam_by_hand, (0.0, 0.5)),
        (Agreeing(), agreeing_by_hand, (0.5, 0.999)),
        (Adan(), adan_by_hand, (0.98, 0.92, 0.99)),
        (Adan((0.9, 0.5, 0.95)), adan_by_hand, (0.9, 0.5, 0.95)),
    ],
    ids=["adam", "long memory", "no momentum", "agreeing", "adan", "short memory"],
)
def test_steps_are_those_of_the_paper(types, optimizer, by_hand, betas):
    """Of a variable whose gradient is always 0 too: it rests."""
    start = np.array([1.0, -2, 0.5, 0])
    steps = 30 if betas[0] else 20  # without momentum it then oscillates, and rounding grows
    path = minimize(optimizer, types.Float(start), lambda x: x * x * x + 3 * dr.sin(x), 0.1, steps)
    expected = by_hand(start, lambda x: x**3 + 3 * np.sin(x), 0.1, steps, betas)
    rtol = 1e-4 if types.bits == 32 else 1e-10
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
def test_betas_that_are_refused(betas):
    name, value = ("beta_2", betas[1]) if 0 <= betas[0] < 1 else ("beta_1", betas[0])
    with pytest.raises(ValueError, match=rf"^Adam: {name} is {value}; "):
        Adam(*betas)
    with pytest.raises(ValueError, match="betas"):
        Adan(betas=(*betas, 0.9))


def test_the_rate_rises_with_an_error_and_falls_with_noise():
    """Of a quadratic: far from its minimum, and near it with derivatives that are mostly noise."""
    types, random = types_in(select("llvm")), np.random.default_rng(1)
    noise = random.normal(size=(100, 500)).astype(np.float32)
    rates = []
    for start, share in ((5.0, 0.0), (0.0, 5.0)):
        optimizer, value = Agreeing(), dr.full(types.Float, start, 500)
        moments = optimizer.start(value)
        for step, row in enumerate(noise):
            slope = value + share * upload(types.Float, row)
            time = dr.opaque(types.Float, step + 1)
            value, moments = optimizer.step(value, slope, moments, types.Float(0.05), time)
            dr.eval(value, moments)
        rates.append(float(np.exp(moments[-1].numpy()[0])))
    assert rates[0] > 0.9 and rates[1] < Agreeing().first


@pytest.mark.parametrize(
    "options", [{"memory": 1.0}, {"least": 0.0}, {"first": 2.0}, {"gain": -1.0}, {"floor": -0.1}]
)
def test_settings_of_rates_that_are_refused(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        Agreeing(**options)


def test_each_row_of_a_variable_has_its_own_rate():
    """As if the rows were two variables."""
    types = types_in(select("llvm"))
    rows = np.float32([[3, 1, -2], [0.1, 0.2, 0.3]])
    whole = minimize(Agreeing(), types.FloatX(rows), lambda x: x * x * x, 0.1, 20)
    for row, path in zip(rows, whole.transpose(1, 0, 2), strict=True):
        alone = minimize(Agreeing(), types.Float(row), lambda x: x * x * x, 0.1, 20)
        np.testing.assert_allclose(path, alone, rtol=1e-6)

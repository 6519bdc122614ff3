"""Joint training: its gradient, its steps and its scaling."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from eigengs_dr.backend.selection import select
from eigengs_dr.paper.joint_training import (
    HALVING_STEPS,
    RATE,
    Band,
    decode_shapes,
    joint_weights,
    train_jointly,
)

WIDTH, HEIGHT = 23, 18
"""No multiples of a tile."""

COUNTS = (8, 3, 0)
"""Components of each channel: a full group, and one with places left."""

SPLATS = 40


def band(counts=COUNTS, seed=0, splats=SPLATS):
    """Smooth waves around another level in each channel."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((HEIGHT, WIDTH)) / WIDTH

    def wave(channel):
        a, b, phase = rng.uniform(-5, 5, 3)
        return 0.02 * np.sin(a * x + b * y + phase) - 0.01 * channel

    planes = tuple(
        np.array([wave(c) for _ in range(k)], np.float32).reshape(k, HEIGHT, WIDTH)
        for c, k in enumerate(counts)
    )
    return Band(splats, planes)


def train(backend, steps, waves=None, state=None):
    """The state after some steps."""
    return list(train_jointly(waves or band(), 0, steps, backend, state))[-1]


def loss_of(state, waves, backend):
    """Mean squared error of all scaled planes, by one rendering of all of them."""
    module = select(backend)
    rows = [module.Float(row) for row in state["rows"][0]]
    dr.enable_grad(rows)
    planes = np.concatenate([(p - p.min()) / np.ptp(p) for p in waves.components if len(p)])
    black = dr.zeros(module.ArrayXf, (len(planes), 1))
    colored = {"color": module.ArrayXf(rows[5:]), "background": black}
    image = eg.render(replace(decode_shapes(rows[:5], waves.size), **colored))
    target = module.TensorXf(np.moveaxis(planes, 0, 2))
    return rows, dr.mean(dr.square(image - target), axis=None)


def test_gradient_is_that_of_all_planes(backend):
    """Those of the second step, at the values after the first."""
    before = train(backend, 1)
    after = train(backend, 2, state=before)
    rows, loss = loss_of(before, band(), backend)
    dr.backward(loss)
    for row, found in zip(rows, after["rows"][4], strict=True):
        expected = dr.grad(row).numpy()
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("step", [2, HALVING_STEPS - 1, HALVING_STEPS])
def test_steps_are_those_of_adan(backend, step):
    """One rate for all, which is halved again and again."""
    before = train(backend, 2) | {"step": np.array(step)}
    after = train(backend, step + 1, state=before)
    rate = RATE * 0.5 ** (step // HALVING_STEPS)
    x, m, v, n, last = before["rows"].astype(np.float64)
    g, t = after["rows"][4], step + 1
    m = 0.98 * m + 0.02 * g
    v = 0.92 * v + 0.08 * (g - last)
    n = 0.99 * n + 0.01 * (g + 0.92 * (g - last)) ** 2
    m_hat, v_hat, n_hat = m / (1 - 0.98**t), v / (1 - 0.92**t), n / (1 - 0.99**t)
    expected = x - rate * (m_hat + 0.92 * v_hat) / (np.sqrt(n_hat) + 1e-8)
    np.testing.assert_allclose(after["rows"][0], expected, atol=0.002 * rate)


@pytest.mark.parametrize("counts", [(0, 3), (2, 9)])
def test_ragged_empty_and_constant_channels(backend, counts):
    """The splats of a constant channel vanish, and what is left is the constant."""
    constant = np.full((2, HEIGHT, WIDTH), 0.25, np.float32)
    waves = band(counts)
    waves = waves._replace(components=(*waves.components, constant))
    state = train(backend, 2, waves)
    assert state["rows"].shape == (5, 5 + sum(counts) + 2, SPLATS)
    assert np.isfinite(state["rows"]).all()
    *others, weights = joint_weights(state, waves)
    assert [len(w) for w in others] == list(counts)
    np.testing.assert_array_equal(weights[:, :-1], 0)
    np.testing.assert_array_equal(weights[:, -1], 0.25)

"""Joint training: its gradient and steps, its scaling, its states."""

import io

import drjit as dr
import numpy as np
import pytest

from eigengs_dr.backend.arrays import types_of
from eigengs_dr.backend.selection import select
from eigengs_dr.eigenbasis.components import joint_training as joint
from eigengs_dr.eigenbasis.components.joint_training import RATE, JointState, train_jointly
from eigengs_dr.fitting.parameterization import CHOLESKY
from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.raster.reference import render_plain
from eigengs_dr.raster.render import bin_gaussians, render

WIDTH, HEIGHT = 23, 18
"""No multiples of a tile."""

COUNTS = (4, 3, 0)
"""Components of each channel: seven make two full groups of three and one with a place left."""

SPLATS = 40


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Small groups compile fast; short rounds yield often."""
    monkeypatch.setattr(joint, "GROUP", 3)
    monkeypatch.setattr(joint, "ROUND", 2)


def components(counts=COUNTS, seed=0):
    """Smooth waves around another level in each channel."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((HEIGHT, WIDTH)) / WIDTH

    def wave(channel):
        a, b, phase = rng.uniform(-5, 5, 3)
        return 0.02 * np.sin(a * x + b * y + phase) - 0.01 * channel

    return tuple(
        np.array([wave(c) for _ in range(k)], np.float32).reshape(k, HEIGHT, WIDTH)
        for c, k in enumerate(counts)
    )


def scaled(planes):
    """All components in [0, 1] by the bounds of their channel, shape (P, H, W)."""
    return np.concatenate([(p - p.min()) / np.ptp(p) for p in planes if len(p)])


def train(backend, steps, planes=None, seed=0, count=SPLATS, **more):
    """All states that are yielded."""
    planes = components() if planes is None else planes
    return list(train_jointly(planes, count, seed, steps, backend=backend, **more))


def assert_equal(first, second):
    for name, value in first.arrays().items():
        np.testing.assert_array_equal(value, second.arrays()[name])


def test_loss_falls(backend):
    states = train(backend, 40)
    losses = [s.loss for s in states]
    assert [s.step for s in states] == list(range(2, 41, 2))
    assert losses == sorted(losses, reverse=True)
    assert losses[-1] < 0.9 * losses[0]


def test_the_start_is_that_of_the_authors(backend):
    """The first step of Adan moves everything by its rate, but for what has no gradient."""
    (state,) = train(backend, 1, count=1000)
    shape, weights = np.split(state.rows[0], [5])
    slack = 1.01 * RATE
    for uniform in (*(0.5 * (np.tanh(shape[:2]) + 1)), *shape[2:], *weights):
        assert -slack <= uniform.min() < 0.02
        assert 0.98 < uniform.max() <= 1 + slack
    assert weights.shape == (sum(COUNTS), 1000)


def plain_loss(rows, planes, backend):
    """Mean squared error of all planes at once, by a renderer that Dr.Jit differentiates."""
    x, y, *factor = rows[:5]
    types = types_of(rows[0])
    zeros = np.zeros((SPLATS, 1))
    fixed = Gaussians.from_arrays(
        np.hstack([zeros, zeros]), zeros + np.array([1, 0, 1]), zeros,
        size=(WIDTH, HEIGHT), space="data", backend=backend,
    )  # fmt: skip
    placed = CHOLESKY.decode(fixed, {"mean": types.Float2(x, y), "cholesky": types.Float3(*factor)})
    values = [*placed.mean, *placed.factor, *rows[5:]]
    image = render_plain(values, [types.Float(0)] * len(planes), bin_gaussians(placed))
    return dr.mean(dr.square(image - types.Float(np.moveaxis(planes, 0, 2).ravel())))


def test_gradient_is_that_of_all_planes(backend, monkeypatch):
    """Those of the second step, at the values after the first."""
    monkeypatch.setattr(joint, "ROUND", 1)
    before, after = train(backend, 2)
    rows = [select(backend).Float(row) for row in before.rows[0]]
    dr.enable_grad(rows)
    loss = plain_loss(rows, scaled(components()), backend)
    dr.backward(loss)
    assert after.loss == pytest.approx(loss[0], rel=1e-5)
    for row, found in zip(rows, after.rows[4], strict=True):
        expected = dr.grad(row).numpy()
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("halved", [1, 2])
def test_steps_are_those_of_adan(backend, monkeypatch, halved):
    """One rate for all, which is halved again and again."""
    monkeypatch.setattr(joint, "ROUND", 1)
    monkeypatch.setattr(joint, "HALVED", halved)
    rate = RATE * 0.5 ** (2 // halved)
    before, after = train(backend, 3)[1:]
    x, m, v, n, last = before.rows.astype(np.float64)
    g = after.rows[4]
    m = 0.98 * m + 0.02 * g
    v = 0.92 * v + 0.08 * (g - last)
    n = 0.99 * n + 0.01 * (g + 0.92 * (g - last)) ** 2
    m_hat, v_hat, n_hat = m / (1 - 0.98**3), v / (1 - 0.92**3), n / (1 - 0.99**3)
    expected = x - rate * (m_hat + 0.92 * v_hat) / (np.sqrt(n_hat) + 1e-8)
    np.testing.assert_allclose(after.rows[0], expected, atol=0.002 * rate)


def test_groups_change_nothing_but_rounding(backend, monkeypatch):
    """The first loss and gradient; further steps would magnify what rounding does to them."""
    (first,) = train(backend, 1)
    monkeypatch.setattr(joint, "GROUP", 2)
    (second,) = train(backend, 1)
    assert first.loss == pytest.approx(second.loss, rel=1e-5)
    largest = np.abs(first.rows[4]).max(axis=1, keepdims=True)
    assert (np.abs(first.rows[4] - second.rows[4]) <= 1e-5 * largest).all()


def test_the_scaling_is_undone(backend):
    """What the weights render to is the scaled rendering, scaled back."""
    planes = components()
    state = train(backend, 4)[-1]
    arrays = state.gaussians(backend).to_arrays()
    assert [w.shape for w in state.weights()] == [(k, SPLATS + 1) for k in COUNTS]

    def rendered(weights, background):
        columns = {"color": weights.T, "background": background}
        everything = Gaussians.from_arrays(
            **{**arrays, **columns}, size=(WIDTH, HEIGHT), space="data", backend=backend
        )
        return render(everything).numpy()

    first = 5
    for channel, weights in zip(planes, state.weights(), strict=True):
        if len(channel):
            in_units = rendered(state.rows[0, first : first + len(channel)], 0 * weights[:, -1])
            expected = in_units * np.ptp(channel) + channel.min()
            np.testing.assert_allclose(
                rendered(weights[:, :-1], weights[:, -1]), expected, rtol=1e-4, atol=1e-6
            )
        first += len(channel)


def test_training_fits_the_components(backend, monkeypatch):
    """The loss is that of what the caller gets, in units of each channel's range."""
    monkeypatch.setattr(joint, "ROUND", 1)
    planes = components((3,))
    before, after = train(backend, 21, planes)[-2:]
    arrays = before.gaussians(backend).to_arrays()
    (weights,) = before.weights()
    arrays |= {"color": weights[:, :-1].T, "background": weights[:, -1]}
    found = Gaussians.from_arrays(**arrays, size=(WIDTH, HEIGHT), space="data", backend=backend)
    errors = (np.moveaxis(render(found).numpy(), 2, 0) - planes[0]) / np.ptp(planes[0])
    assert after.loss == pytest.approx(np.square(errors).mean(), rel=1e-3)


def test_a_constant_channel(backend):
    """Its splats vanish, and what is left is the constant."""
    constant = np.full((2, HEIGHT, WIDTH), 0.25, np.float32)
    state = train(backend, 2, (components()[0], constant))[-1]
    weights = state.weights()[1]
    np.testing.assert_array_equal(weights[:, :-1], 0)
    np.testing.assert_array_equal(weights[:, -1], 0.25)
    assert np.isfinite(state.rows).all()


@pytest.mark.parametrize("counts", [(0, 3), (1, 0, 0), (2, 5)])
def test_ragged_and_empty_channels(backend, counts):
    state = train(backend, 2, components(counts))[-1]
    assert state.counts == counts
    assert state.rows.shape == (5, 5 + sum(counts), SPLATS)
    assert [len(w) for w in state.weights()] == list(counts)
    assert np.isfinite(state.rows).all()


def test_one_seed_gives_one_result(backend):
    first, second, other = (train(backend, 4, seed=seed)[-1] for seed in (1, 1, 2))
    assert_equal(first, second)
    assert not np.array_equal(first.rows, other.rows)


def test_going_on_equals_an_unbroken_run(backend):
    """From a checkpoint, bit by bit; states that were yielded have not changed meanwhile."""
    whole = train(backend, 7)
    assert [s.step for s in whole] == [2, 4, 6, 7]
    training = train_jointly(components(), SPLATS, 0, 7, backend=backend)
    file = io.BytesIO()
    np.savez(file, **next(training).arrays())
    training.close()
    file.seek(0)
    state = JointState.from_arrays(dict(np.load(file)))
    assert_equal(state, whole[0])
    for found, expected in zip(train(backend, 7, state=state), whole[1:], strict=True):
        assert_equal(found, expected)


def test_nothing_is_left_to_do(backend):
    state = train(backend, 2)[-1]
    assert train(backend, 2, state=state) == []


def test_the_components_are_left_alone(backend):
    planes = components()
    train(backend, 2, planes)
    for plane, same in zip(planes, components(), strict=True):
        np.testing.assert_array_equal(plane, same)


def test_replays_compile_nothing(backend):
    """Once a run was made, one of other components and another seed uses its kernels."""
    train(backend, 4)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        train(backend, 4, components(seed=1), seed=1)
        history = dr.kernel_history([dr.KernelType.JIT])
    assert history
    assert all(kernel["cache_hit"] for kernel in history)


@pytest.mark.parametrize(
    ("planes", "words"),
    [
        (components((0, 0)), "there are none to fit"),
        ((components()[0], components()[1][:, :-1]), "differ in size"),
    ],
)
def test_components_that_cannot_be_fitted(planes, words):
    with pytest.raises(ValueError, match=words):
        train_jointly(planes, SPLATS, 0, 2)


def test_a_state_of_other_work(backend):
    state = train(backend, 1)[-1]
    for planes, count in ((components(), SPLATS + 1), (components((4, 3, 1)), SPLATS)):
        with pytest.raises(ValueError, match="other components or another number of Gaussians"):
            train_jointly(planes, count, 0, 2, backend=backend, state=state)

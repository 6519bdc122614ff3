"""The variables that optimisers move, and the optimisers, against their algorithms by hand."""

import drjit as dr
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from _helpers.footprints import matrices
from _helpers.sets import COUNT, SIZE, few, random_scene, scenes
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.parameterization import (
    CHOLESKY,
    CHOLESKY_BOUND,
    MIN_DIAGONAL,
    SCALE_RELATIVE,
    Adam,
    Adan,
)
from eigengs_dr.gaussian.gaussians import MIN_DEVIATION


@few
@given(scene=scenes())
@pytest.mark.parametrize("coordinates", [SCALE_RELATIVE, CHOLESKY], ids=["natural", "cholesky"])
def test_there_and_back(backend, coordinates, scene):
    """Those of GaussianImage hold means inside the image only."""
    scene = scene._replace(mean=np.clip(scene.mean, 0.01, np.array(SIZE) - 0.01))
    gaussians = scene.on(backend)
    back = coordinates.decode(gaussians, coordinates.encode(gaussians)).to_arrays()
    np.testing.assert_allclose(back["mean"], scene.mean, atol=1e-3)
    scale = np.abs(scene.factor).max(axis=1, keepdims=True)
    assert (np.abs(back["factor"] - scene.factor) <= 1e-4 * scale).all()
    np.testing.assert_array_equal(back["color"], np.float32(scene.color))
    np.testing.assert_array_equal(back["background"], np.float32(scene.background))


def test_cholesky_coordinates(backend):
    """``Sigma = L L^T`` with the bound on L's diagonal; means through tanh."""
    rng = np.random.default_rng(0)
    variables = {"mean": rng.normal(size=(2, COUNT)), "cholesky": rng.uniform(0, 2, (3, COUNT))}
    module = select(backend)
    fixed = random_scene().on(backend)
    moved = CHOLESKY.decode(
        fixed,
        {
            "mean": module.Array2f(*variables["mean"].astype("f4")),
            "cholesky": module.Array3f(*variables["cholesky"].astype("f4")),
            "color": fixed.color,
        },
    ).to_arrays()
    l1, l2, l3 = variables["cholesky"] + np.array([[CHOLESKY_BOUND], [0], [CHOLESKY_BOUND]])
    lower = np.array([[l1, 0 * l1], [l2, l3]]).transpose(2, 0, 1)
    covariance = matrices(*moved["factor"].astype(float).T)
    expected = np.einsum("nij,nkj->nik", lower, lower)
    np.testing.assert_allclose(covariance, expected, rtol=1e-4, atol=1e-4)
    expected = (np.tanh(variables["mean"].T) + 1) / 2 * SIZE
    np.testing.assert_allclose(moved["mean"], expected, rtol=1e-5)


@pytest.mark.parametrize("coordinates", [SCALE_RELATIVE, CHOLESKY], ids=["natural", "cholesky"])
def test_what_is_not_a_variable_is_that_of_the_set(backend, coordinates):
    """As `Coordinates.to` says."""
    gaussians = random_scene().on(backend)
    moved = coordinates.decode(gaussians, {"color": gaussians.color * 2}).to_arrays()
    np.testing.assert_array_equal(moved["mean"], gaussians.to_arrays()["mean"])
    np.testing.assert_array_equal(moved["factor"], gaussians.to_arrays()["factor"])


any_floats = st.floats(width=32, allow_nan=True, allow_infinity=True)


@few
@given(values=hnp.arrays(np.float32, (8, COUNT), elements=any_floats))
def test_natural_variables_come_back_into_their_bounds(backend, values):
    module = select(backend)
    fixed = random_scene().on(backend)
    variables = {
        "mean": module.Array2f(*values[:2]),
        "factor": module.Array3f(*values[2:5]),
        "color": module.ArrayXf(list(values[5:])),
    }
    found = SCALE_RELATIVE.decode(fixed, SCALE_RELATIVE.project(fixed, variables)).to_arrays()
    slack = 1 + 1e-5  # of going through the units of the variables
    assert ((found["mean"] >= 0) & (found["mean"] <= np.array(SIZE) * slack)).all()
    diagonal = found["factor"][:, [0, 2]]
    assert (diagonal * slack >= 1 / (2 * max(SIZE))).all()
    assert (np.abs(found["factor"]) <= slack / MIN_DEVIATION).all()
    assert np.isfinite(found["color"]).all()


SUBNORMAL = np.finfo(np.float32).smallest_subnormal


@few
@given(values=hnp.arrays(np.float32, (3, COUNT), elements=st.floats(-100, 100, width=32)))
@example(values=np.full((3, COUNT), SUBNORMAL))
def test_covariances_of_cholesky_variables_are_never_singular(backend, values):
    """A diagonal entry of 0 would make its set not finite; other entries stay as they are."""
    module = select(backend)
    fixed = random_scene().on(backend)
    variables = {"cholesky": module.Array3f(*values)}
    inside = CHOLESKY.project(fixed, variables)
    expected = values.copy()
    expected[[0, 2]] = np.maximum(values[[0, 2]], np.float32(MIN_DIAGONAL - CHOLESKY_BOUND))
    flushed = np.finfo(np.float32).tiny  # llvm may take a number below this one for 0
    np.testing.assert_allclose(inside["cholesky"].numpy(), expected, rtol=0, atol=flushed)
    assert np.isfinite(CHOLESKY.decode(fixed, inside).to_arrays()["factor"]).all()


def minimize(optimizer, value, gradient, rate, steps):
    """Values after each step, shape (steps, n), for ``gradient(value)`` on the device."""
    Float, moments, path = type(value), optimizer.start(value), []
    for t in range(1, steps + 1):
        value, moments = optimizer.step(value, gradient(value), moments, Float(rate), Float(t))
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


@pytest.mark.parametrize(
    ("optimizer", "by_hand", "betas"),
    [
        (Adam(0.9, 0.9, 1e-12), adam_by_hand, (0.9, 0.9)),
        (Adam(0.9, 0.99, 1e-12), adam_by_hand, (0.9, 0.99)),
        (Adam(0.0, 0.5, 1e-12), adam_by_hand, (0.0, 0.5)),
        (Adan(), adan_by_hand, (0.98, 0.92, 0.99)),
        (Adan((0.9, 0.5, 0.95)), adan_by_hand, (0.9, 0.5, 0.95)),
    ],
    ids=str,
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
    with pytest.raises(ValueError, match="betas"):
        Adam(*betas)
    with pytest.raises(ValueError, match="betas"):
        Adan(betas=(*betas, 0.9))

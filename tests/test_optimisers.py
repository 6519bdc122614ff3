"""Adam, Adan, and the variables that they move."""

import drjit as dr
import drjit.opt
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scenes import COUNT, SIZE, few, random_scene, scenes

from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.optimizers.adam import Adam
from eigengs_dr.fitting.optimizers.adan import Adan
from eigengs_dr.fitting.optimizers.parameterization import CHOLESKY, CHOLESKY_BOUND, SCALE_RELATIVE
from eigengs_dr.gaussian.gaussians import MIN_DEVIATION

# --- Adam --------------------------------------------------------------------------------------


@pytest.mark.parametrize("betas", [(0.9, 0.9), (0.9, 0.99)])
def test_adam_is_that_of_drjit_where_that_works(backend, betas):
    """Equal to the last bit, over the step from which on nothing is debiased."""
    Float = select(backend).Float
    settings = {"beta_1": betas[0], "beta_2": betas[1], "epsilon": 1e-12}
    ours, theirs = (kind(0.1, {"x": Float(1, -2)}, **settings) for kind in (Adam, drjit.opt.Adam))
    for first in (0, ours.last - 5):
        for optimizer in (ours, theirs):
            _, *averages = optimizer.state["x"][-1]
            optimizer.state["x"] = *optimizer.state["x"][:-1], (UInt(backend, first), *averages)
        for _ in range(10):
            for optimizer in (ours, theirs):
                dr.backward(dr.square(optimizer["x"]) * Float(1, 3))
                optimizer.step()
            np.testing.assert_array_equal(ours["x"].numpy(), theirs["x"].numpy())


def UInt(backend, value):
    return dr.opaque(select(backend).UInt32, value)


def test_adam_survives_the_steps_at_which_a_power_leaves_the_range_of_doubles(backend):
    """With a beta of 0.9 the steps 6,734 to 6,736: Dr.Jit's own makes all variables NaN."""
    Float = select(backend).Float
    optimizer = Adam(0.1, {"x": Float(1, -2)}, beta_1=0.9, beta_2=0.9, epsilon=1e-12)
    for t in range(6700, 6760):
        _, *averages = optimizer.state["x"][-1]
        optimizer.state["x"] = *optimizer.state["x"][:-1], (UInt(backend, t), *averages)
        dr.backward(optimizer["x"] * Float(3, -4))
        optimizer.step()
    # Averages that start at 0 and are not debiased hold a share of 1 - 0.9^k of a steady gradient.
    moved = 0.1 * sum(np.sqrt(1 - 0.9**k) for k in range(1, 61))
    np.testing.assert_allclose(optimizer["x"].numpy(), [1 - moved, -2 + moved], rtol=1e-4)


def test_adam_refuses_averages_of_which_one_outlives_the_range_of_the_other():
    with pytest.raises(ValueError, match="closer to each other"):
        Adam(0.1, beta_1=0.9, beta_2=0.999)


# --- Adan --------------------------------------------------------------------------------------


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


# --- Coordinates -------------------------------------------------------------------------------


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
    a, b, c = moved["factor"].astype(float).T
    factor = np.array([[a, b], [0 * a, c]]).transpose(2, 0, 1)
    inverse = np.einsum("nji,njk->nik", factor, factor)
    np.testing.assert_allclose(
        np.linalg.inv(inverse), np.einsum("nij,nkj->nik", lower, lower), rtol=1e-4, atol=1e-4
    )
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

"""The variables that optimisers move: there and back, and their bounds."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from _helpers.footprints import matrices
from _helpers.sets import COUNT, SIZE, few, random_scene, scenes
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.state import Relative
from eigengs_dr.gaussian.gaussians import MIN_DEVIATION
from eigengs_dr.paper.gaussianimage import CHOLESKY_BOUND, MIN_DIAGONAL, Cholesky

RELATIVE, CHOLESKY = Relative(), Cholesky()
both = pytest.mark.parametrize("coordinates", [RELATIVE, CHOLESKY], ids=["relative", "cholesky"])


@few
@given(scene=scenes())
@both
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


@both
def test_what_is_not_a_variable_is_that_of_the_set(backend, coordinates):
    """As `Coordinates` says."""
    gaussians = random_scene().on(backend)
    moved = coordinates.decode(gaussians, {"color": gaussians.color * 2}).to_arrays()
    np.testing.assert_array_equal(moved["mean"], gaussians.to_arrays()["mean"])
    np.testing.assert_array_equal(moved["factor"], gaussians.to_arrays()["factor"])


any_floats = st.floats(width=32, allow_nan=True, allow_infinity=True)


@few
@given(values=hnp.arrays(np.float32, (8, COUNT), elements=any_floats))
def test_relative_variables_come_back_into_their_bounds(backend, values):
    module = select(backend)
    fixed = random_scene().on(backend)
    variables = {
        "mean": module.Array2f(*values[:2]),
        "factor": module.Array3f(*values[2:5]),
        "color": module.ArrayXf(list(values[5:])),
    }
    found = RELATIVE.decode(fixed, RELATIVE.project(fixed, variables)).to_arrays()
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

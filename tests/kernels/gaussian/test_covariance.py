"""Forms of covariances against linear algebra in double precision."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from _helpers.log_shapes import factors_from_log_shapes
from _helpers.sets import few
from eigengs_dr.gaussian.covariance import (
    factor_from_covariance,
    log_shapes,
    max_deviation,
)


def draw(seed, count=50):
    """Random factors, needles among them, and their covariances (N, 2, 2)."""
    generator = np.random.default_rng(seed)
    a, c = np.exp(generator.uniform(-3, 3, (2, count)))
    b = generator.normal(size=count) * np.exp(generator.uniform(-3, 2, count))
    factor = np.stack([a, b, c], axis=1)
    whole = np.zeros((count, 2, 2))
    whole[:, 0, 0], whole[:, 0, 1], whole[:, 1, 1] = a, b, c
    inverse = np.linalg.inv(whole)
    return factor, inverse @ np.swapaxes(inverse, 1, 2)


seeds = given(st.integers(0, 2**32 - 1))


@few
@seeds
def test_factors_of_covariances(seed):
    factor, covariance = draw(seed)
    found = factor_from_covariance(covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1])
    well = np.linalg.cond(covariance) < 1e6  # entries of needles do not hold their determinant
    np.testing.assert_allclose(found[well], factor[well], rtol=1e-5, atol=1e-6)
    assert found[well, 2].min() > 0


@few
@seeds
def test_eigenvalues(seed):
    factor, covariance = draw(seed)
    values = np.linalg.eigvalsh(covariance)
    np.testing.assert_allclose(max_deviation(*factor.T), np.sqrt(values[:, 1]), rtol=1e-9)


@few
@seeds
def test_logarithms_there_and_back(seed):
    factor, covariance = draw(seed)
    shape = log_shapes(factor)
    np.testing.assert_allclose(factors_from_log_shapes(shape), factor, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(np.exp(-shape[:, 0]), np.linalg.det(covariance) ** 0.25, rtol=1e-6)

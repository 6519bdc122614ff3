"""The reference is the formula."""

import numpy as np

from _helpers.sets import COUNT, SIZE, covariances, factors_of
from eigengs_dr.raster.reference import render_exact


def test_reference_is_the_formula():
    """``exp(-1/2 d^T Sigma^-1 d)`` with the covariances from which the factors came."""
    rng = np.random.default_rng(0)
    covariance = covariances(rng.uniform(0.5, 9, (COUNT, 2)), rng.uniform(0, np.pi, COUNT))
    mean, color = rng.uniform(-2, 24, (COUNT, 2)), rng.normal(size=(COUNT, 3))
    found = render_exact(mean, factors_of(covariance), color, np.array([1.0, 2, 3]), *SIZE)
    row, column = 4, 11
    d = np.array([column + 0.5, row + 0.5]) - mean
    weight = np.exp(-0.5 * np.einsum("ni,nij,nj->n", d, np.linalg.inv(covariance), d))
    np.testing.assert_allclose(found[row, column], [1, 2, 3] + weight @ color, rtol=1e-12)
    assert found.shape == (SIZE[1], SIZE[0], 3)

"""Reciprocals and the hyperbolic tangent: as accurate as NumPy's on every backend."""

import drjit as dr
import numpy as np
import pytest

from eigengs_dr.backend.arithmetic import TANH_SMALL, rcp, rsqrt, tanh

TOLERANCE = {32: 1e-6, 64: 1e-14}
"""Relative error by precision: Dr.Jit's own functions miss it on cuda in one of the two."""

POSITIVE = np.geomspace(1e-6, 1e6, 2001)
SIGNED = np.concatenate([-POSITIVE, POSITIVE])
TO_TANH = np.concatenate([np.geomspace(1e-20, 30, 2001), TANH_SMALL + np.linspace(-0.1, 0.1, 999)])


def value_and_slope(types, function, x):
    """A function at points, rounded to the precision, and its derivative there."""
    variable = types.Float(x)
    dr.enable_grad(variable)
    value = function(variable)
    dr.backward(dr.sum(value))
    return value.numpy(), variable.grad.numpy(), variable.numpy().astype(np.float64)


@pytest.mark.parametrize(
    ("function", "points", "value", "slope"),
    [
        (rcp, SIGNED, lambda x: 1 / x, lambda x: -(x**-2.0)),
        (rsqrt, POSITIVE, lambda x: x**-0.5, lambda x: -0.5 * x**-1.5),
        (tanh, TO_TANH, np.tanh, lambda x: np.cosh(x) ** -2.0),
        (tanh, -TO_TANH, np.tanh, lambda x: np.cosh(x) ** -2.0),
    ],
)
def test_values_and_derivatives_are_those_of_numpy(types, function, points, value, slope):
    tolerance = TOLERANCE[types.bits]
    found, derivative, x = value_and_slope(types, function, points)
    np.testing.assert_allclose(found, value(x), rtol=tolerance)
    # exp(-60) of the largest v is good to 60 roundings of its argument.
    np.testing.assert_allclose(
        derivative, slope(x), rtol=60 * tolerance if function is tanh else tolerance
    )


def test_tanh_ends_at_one(types):
    value, slope, _ = value_and_slope(types, tanh, np.array([np.inf, -np.inf, 1e30, -1e30]))
    np.testing.assert_array_equal(value, [1, -1, 1, -1])
    np.testing.assert_array_equal(slope, 0)


def test_tanh_keeps_nan(types):
    value, _, _ = value_and_slope(types, tanh, np.array([np.nan, 0.0]))
    np.testing.assert_array_equal(value, [np.nan, 0])


def test_arrays_of_several(types):
    pair = types.Float2([1, 2], [4, 5])
    for function in (rcp, rsqrt, tanh):
        found = function(pair)
        assert type(found) is type(pair)
        assert dr.all(found.y == function(pair.y))

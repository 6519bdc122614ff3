"""Arrays of a backend: their types, uploads, and arithmetic that is as good as NumPy's."""

import drjit as dr
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from _helpers.sets import few
from eigengs_dr.backend.arrays import make_divisor, rcp, rsqrt

TOLERANCE = {32: 1e-6, 64: 1e-14}
"""Relative error by precision: Dr.Jit's own functions miss it on cuda in one of the two."""

POSITIVE = np.geomspace(1e-6, 1e6, 2001)
SIGNED = np.concatenate([-POSITIVE, POSITIVE])


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
    ],
)
def test_values_and_derivatives_are_those_of_numpy(types, function, points, value, slope):
    tolerance = TOLERANCE[types.bits]
    found, derivative, x = value_and_slope(types, function, points)
    np.testing.assert_allclose(found, value(x), rtol=tolerance)
    np.testing.assert_allclose(derivative, slope(x), rtol=tolerance)


@few
@example(divisor=1, values=[])
@example(divisor=64, values=[])
@example(divisor=2**30 + 1, values=[])
@example(divisor=2**31 - 1, values=[])
@given(divisor=st.integers(1, 2**31 - 1), values=st.lists(st.integers(0, 2**31 - 1), max_size=20))
def test_division_by_an_integer_is_exact(types, divisor, values):
    """Also next to multiples, and up to the largest values."""
    near = [k * divisor + d for k in (1, 2, 2**31 // divisor) for d in (-1, 0, 1)]
    n = np.array([v for v in [0, 2**31 - 1, *near, *values] if 0 <= v < 2**31], np.uint32)
    quotient, remainder = make_divisor(types, divisor).divmod(types.UInt(n))
    np.testing.assert_array_equal(quotient.numpy(), n // divisor)
    np.testing.assert_array_equal(remainder.numpy(), n % divisor)

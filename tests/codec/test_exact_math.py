"""Functions of exact arithmetic: near the true values."""

import numpy as np

from eigengs_dr.codec.exact_math import angle_in_turns, cos_turns, exp2, log2, sin_turns


def test_functions_are_near_those_of_numpy():
    x, y = np.random.default_rng(0).normal(0, 9, (2, 5000))
    np.testing.assert_allclose(exp2(x), 2**x, rtol=1e-10)
    np.testing.assert_allclose(log2(np.abs(x)), np.log2(np.abs(x)), atol=1e-9)
    np.testing.assert_allclose(sin_turns(x), np.sin(2 * np.pi * x), atol=1e-8)
    np.testing.assert_allclose(cos_turns(x), np.cos(2 * np.pi * x), atol=1e-8)
    np.testing.assert_allclose(angle_in_turns(y, x), np.arctan2(y, x) / (2 * np.pi), atol=1e-9)


def test_special_values():
    assert angle_in_turns(np.zeros(1), np.zeros(1)) == 0
    assert angle_in_turns(np.zeros(1), -np.ones(1)) == 0.5
    np.testing.assert_array_equal(cos_turns(np.array([0.25, 0.75])), 0)
    assert np.isfinite(exp2(np.array([1e30, -1e30]))).all()
    np.testing.assert_array_equal(exp2(np.arange(-9, 9)), 2.0 ** np.arange(-9, 9))


def test_the_bits_are_those_of_every_machine():
    """Sums and products alone, in one order: the bits of this machine are those of all."""
    x = np.linspace(-3, 3, 7)
    assert exp2(x).tobytes().hex()[:32] == "000000000000c03f000000000000d03f"
    assert [float(v).hex() for v in (exp2(np.array(0.3)), log2(np.array(3.0)))] == [
        "0x1.3b2c47bff826ap+0",
        "0x1.95c01a39fe66fp+0",
    ]

"""Integers as bits of a range coder; the curve through cells; exact arithmetic."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from eigengs_dr.codec.exact_math import angle_in_turns, cos_turns, exp2, log2, sin_turns
from eigengs_dr.codec.range_coder import TAILS, Decoder, Encoder, hilbert_encode

# --- Numbers ---


NUMBERS = st.one_of(st.integers(-9, 9), st.integers(-(1 << 45), 1 << 45))
WIDTHS = st.floats(1e-9, 1e12) | st.just(np.inf) | st.just(np.nan)


def coded(method, *arguments):
    """The bytes of integers, which are the last argument and come back."""
    encoder, values = Encoder(), arguments[-1]
    getattr(encoder, method)(*arguments)
    data = encoder.to_bytes()
    found = getattr(Decoder(data), method)(*arguments[:-1], np.zeros_like(values))
    np.testing.assert_array_equal(found, values)
    return data


@given(
    hnp.arrays(np.int64, st.integers(1, 40), elements=NUMBERS),
    st.floats(-1e6, 1e6),
    WIDTHS,
    st.sampled_from(TAILS),
)
def test_numbers_come_back_whatever_was_expected(values, center, width, tails):
    coded("numbers", np.full(len(values), center), np.full(len(values), width), tails, values)


@pytest.mark.parametrize("tails", TAILS)
@pytest.mark.parametrize("width", [0.3, 300.0])
def test_numbers_come_close_to_their_entropy(tails, width):
    generator = np.random.default_rng(0)
    center = generator.uniform(-5, 5, 20000)
    values = np.rint(center + width * generator.standard_t(tails, 20000)).astype(np.int64)
    away = values - np.rint(center).astype(np.int64)
    share = np.unique(away, return_counts=True)[1] / len(away)
    least = -(share * np.log2(share)).sum() + (np.log2(0.8) if width > 100 else 0)
    data = coded("numbers", center, np.full(20000, width), tails, values)
    assert 8 * len(data) / 20000 < 1.03 * least + 0.1 + (width > 100)


# --- The curve through cells ---


@pytest.mark.parametrize("levels", [0, 1, 5])
def test_the_curve_visits_every_point_by_single_steps(levels):
    side = 1 << levels
    points = np.indices((side, side)).reshape(2, -1).T
    places = hilbert_encode(points, levels)
    assert sorted(places) == list(range(side * side))
    path = points[np.argsort(places)]
    assert (np.abs(np.diff(path, axis=0)).sum(axis=1) == 1).all()


# --- Exact arithmetic ---


def test_functions_are_near_those_of_numpy():
    x, y = np.random.default_rng(0).normal(0, 9, (2, 5000))
    np.testing.assert_allclose(exp2(x), 2**x, rtol=1e-10)
    np.testing.assert_allclose(log2(np.abs(x)), np.log2(np.abs(x)), atol=1e-9)
    np.testing.assert_allclose(sin_turns(x), np.sin(2 * np.pi * x), atol=1e-8)
    np.testing.assert_allclose(cos_turns(x), np.cos(2 * np.pi * x), atol=1e-8)
    np.testing.assert_allclose(angle_in_turns(y, x), np.arctan2(y, x) / (2 * np.pi), atol=1e-9)
    assert angle_in_turns(np.zeros(1), np.zeros(1)) == 0
    assert angle_in_turns(np.zeros(1), -np.ones(1)) == 0.5
    assert np.isfinite(exp2(np.array([1e30, -1e30]))).all()
    np.testing.assert_array_equal(exp2(np.arange(-9, 9)), 2.0 ** np.arange(-9, 9))


def test_the_bits_are_those_of_every_machine():
    """Sums and products alone, in one order: the bits of this machine are those of all."""
    assert exp2(np.linspace(-3, 3, 7)).tobytes().hex()[:32] == "000000000000c03f000000000000d03f"
    assert [float(v).hex() for v in (exp2(np.array(0.3)), log2(np.array(3.0)))] == [
        "0x1.3b2c47bff826ap+0",
        "0x1.95c01a39fe66fp+0",
    ]

"""Integers as bits of a range coder."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from eigengs_dr.codec.range_coder import TAILS, Decoder, Encoder

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


def test_every_integer_may_have_its_own_size():
    sizes = np.array([1, 2, 1 << 20, 1, 7, 1 << 16])
    coded("uniform", sizes, np.array([0, 1, 12345, 0, 6, 65535]))


@pytest.mark.parametrize("tails", TAILS)
@pytest.mark.parametrize("width", [0.3, 3.0, 300.0])
def test_numbers_come_close_to_their_entropy(tails, width):
    generator = np.random.default_rng(0)
    center = generator.uniform(-5, 5, 20000)
    values = np.rint(center + width * generator.standard_t(tails, 20000)).astype(np.int64)
    away = values - np.rint(center).astype(np.int64)
    share = np.unique(away, return_counts=True)[1] / len(away)
    least = -(share * np.log2(share)).sum() + (np.log2(0.8) if width > 100 else 0)
    data = coded("numbers", center, np.full(20000, width), tails, values)
    assert 8 * len(data) / 20000 < 1.03 * least + 0.1 + (width > 100)

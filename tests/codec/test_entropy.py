"""Planes of whole numbers."""

import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from _helpers.packed import peak
from eigengs_dr.codec import entropy as planes
from eigengs_dr.codec.quantization import MAX_SYMBOL
from eigengs_dr.storage.npz import BadValue

NUMBERS = st.one_of(
    st.integers(-9, 9), st.integers(0, (1 << 48) - 1), st.integers(-MAX_SYMBOL, MAX_SYMBOL)
)


@given(hnp.arrays(np.int64, st.integers(1, 40), elements=NUMBERS), st.binary(max_size=4))
def test_planes_come_back_and_end_where_they_end(values, rest):
    found, left = planes.decode(memoryview(planes.encode(values) + rest), len(values))
    np.testing.assert_array_equal(found, values)
    assert bytes(left) == rest


def test_planes_come_close_to_their_entropy():
    values = np.random.default_rng(0).normal(0, 12, 5000).round().astype(np.int64)
    share = np.unique(values, return_counts=True)[1] / len(values)
    least = -len(values) * (share * np.log2(share)).sum() / 8
    assert least < len(planes.encode(values)) < 1.03 * least + 30


@given(st.binary(max_size=60), st.integers(1, 50))
def test_planes_of_any_bytes(data, count):
    for head in (b"", b"\x01\0\0", b"\x0a\x05\0"):
        try:
            values, _ = planes.decode(memoryview(head + data), count)
        except BadValue:
            continue
        assert values.shape == (count,)


def test_planes_cut_off_anywhere():
    _round_to_steps = planes.encode(np.array([3, 1 << 30, 5, 77777], np.int64))
    for length in range(len(_round_to_steps)):
        with pytest.raises(BadValue):
            planes.decode(memoryview(_round_to_steps[:length]), 4)


def test_planes_that_claim_much():
    bomb = zlib.compress(bytes(1 << 24), 9, -15)
    with pytest.raises(BadValue, match="does not hold 9"):
        planes.decode(memoryview(b"\x01\0\0" + bomb), 9)
    wide = zlib.compress(bytes([255] * 9), 9, -15)  # widths of 127 bits
    with pytest.raises(BadValue, match="more bits"):
        planes.decode(memoryview(b"\x01\0\0" + wide + bytes(999)), 9)


def test_low_bits_take_no_more_memory_than_numbers():
    """Of numbers of 47 bits each, where a number a bit would be forty times as much."""
    values = np.random.default_rng(0).integers(1 << 46, 1 << 47, 1 << 16)
    coded = memoryview(planes.encode(values))
    assert peak(lambda: planes.decode(coded, len(values))) < 12 * values.nbytes

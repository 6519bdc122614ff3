"""Sections of a file: the cells of a plane."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from eigengs_dr.codec.egs_section import EVENNESS, code_cells, morton_encode
from eigengs_dr.codec.range_coder import Decoder, Encoder


@given(
    hnp.arrays(np.int64, st.tuples(st.integers(1, 60), st.just(2)), elements=st.integers(0, 15)),
    st.sampled_from(EVENNESS),
    st.sampled_from([4, 24]),
)
def test_cells_come_back_in_their_order(cells, evenness, levels):
    encoder = Encoder()
    code_cells(encoder, len(cells), levels, evenness, cells)
    found = code_cells(Decoder(encoder.to_bytes()), len(cells), levels, evenness)
    order = np.argsort(morton_encode(cells, levels), kind="stable")
    np.testing.assert_array_equal(found, cells[order])


def test_many_gaussians_in_one_cell():
    cells = np.full((1 << 21, 2), 3)
    encoder = Encoder()
    code_cells(encoder, len(cells), 3, 1, cells)
    assert (code_cells(Decoder(encoder.to_bytes()), len(cells), 3, 1) == 3).all()


@pytest.mark.parametrize("count", [200, 3000])
def test_the_order_is_not_stored(count):
    cells = np.random.default_rng(0).integers(0, 256, (count, 2))
    encoder = Encoder()
    code_cells(encoder, count, 8, 64, cells)
    # log2(M^N / N!) bits for M cells
    least = count * (16 - np.log2(count) + np.log2(np.e))
    assert 8 * len(encoder.to_bytes()) < 1.04 * least + 32

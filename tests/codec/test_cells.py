"""Cells of a plane, coded without their order."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from eigengs_dr.codec.cells import EVENNESS, code_cells, morton_encode
from eigengs_dr.codec.range_coder import Decoder, Encoder


def coded(cells, *arguments):
    """The bytes of cells, which come back in the order of `morton_encode`."""
    encoder = Encoder()
    code_cells(encoder, cells, *arguments)
    data = encoder.to_bytes()
    found = code_cells(Decoder(data), np.zeros_like(cells), *arguments)
    order = np.argsort(morton_encode(cells, arguments[0]), kind="stable")
    np.testing.assert_array_equal(found, cells[order])
    return data


@given(
    hnp.arrays(np.int64, st.tuples(st.integers(1, 60), st.just(2)), elements=st.integers(0, 15)),
    st.sampled_from(EVENNESS),
    st.sampled_from([4, 24]),
)
def test_cells_come_back(cells, evenness, levels):
    coded(cells, levels, evenness)


def test_many_gaussians_in_one_cell():
    coded(np.full((1 << 21, 2), 3), 3, 1)

"""Cells of a plane, coded without their order, and the Hilbert curve through them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from eigengs_dr.codec.range_coder import (
    EVENNESS,
    MAX_LEVELS,
    Decoder,
    Encoder,
    code_cells,
    hilbert_encode,
    morton_encode,
)


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


@pytest.mark.parametrize("levels", [0, 1, 2, 5])
def test_the_curve_visits_every_point_by_single_steps(levels):
    side = 1 << levels
    points = np.indices((side, side)).reshape(2, -1).T
    places = hilbert_encode(points, levels)
    assert sorted(places) == list(range(side * side))
    path = points[np.argsort(places)]
    assert (np.abs(np.diff(path, axis=0)).sum(axis=1) == 1).all()


@given(hnp.arrays(np.int64, (7, 2), elements=st.integers(0, (1 << MAX_LEVELS) - 1)))
def test_places_on_the_largest_curve_are_one_for_each_point(points):
    places = hilbert_encode(points, MAX_LEVELS)
    assert (places >> 2 * MAX_LEVELS == 0).all()
    assert len(np.unique(places)) == len(np.unique(points, axis=0))

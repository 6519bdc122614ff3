"""The Hilbert curve over an image of any size."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from _helpers.sets import few
from eigengs_dr.fitting.placement.hilbert_scan import hilbert_order


@few
@given(height=st.integers(1, 40), width=st.integers(1, 40))
def test_hilbert_order_visits_every_pixel_once(height, width):
    order = hilbert_order(height, width)
    assert sorted(order) == list(range(height * width))


@pytest.mark.parametrize("side", [1, 2, 4, 8, 32])
def test_hilbert_curve_steps_to_neighbours(side):
    row, column = np.divmod(hilbert_order(side, side), side)
    assert (np.abs(np.diff(row)) + np.abs(np.diff(column)) == 1).all()


@pytest.mark.parametrize("side", [4, 16])
def test_hilbert_curve_stays_in_a_quarter(side):
    """Any quarter of the curve is a quarter of the square, and a quarter of that again."""
    order = hilbert_order(side, side)
    block = side
    while block > 1:
        block //= 2
        parts = order.reshape(-1, block * block)
        row, column = np.divmod(parts, side)
        assert (np.ptp(row, axis=1) == block - 1).all()
        assert (np.ptp(column, axis=1) == block - 1).all()

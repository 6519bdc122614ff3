"""The Hilbert curve over an image of any size."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from _helpers.sets import few
from eigengs_dr.fitting.placement.hilbert_scan import SQUARE, hilbert_squares


def hilbert_order(height, width):
    """The indices ``row * width + column`` of all pixels, in the order of the curve."""
    parts = []
    for square in hilbert_squares(height, width):
        row, column = square.order()
        parts.append((square.rows.start + row) * width + square.columns.start + column)
    return np.concatenate(parts)


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


def test_squares_of_a_large_image_are_cut_from_one_curve():
    """The order does not depend on the side of the squares, and the squares overhang the image."""
    height, width = SQUARE + 3, 2 * SQUARE - 5
    order = hilbert_order(height, width)
    assert len(hilbert_squares(height, width)) == 4
    np.testing.assert_array_equal(np.sort(order), np.arange(height * width))
    row, column = np.divmod(hilbert_order(2 * SQUARE, 2 * SQUARE), 2 * SQUARE)
    inside = (row < height) & (column < width)
    np.testing.assert_array_equal(order, row[inside] * width + column[inside])
    steps = np.abs(np.diff(row)) + np.abs(np.diff(column))
    assert (steps == 1).all()

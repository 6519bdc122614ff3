"""The Hilbert curve: numbers of points along it, and images of any size."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from _helpers.sets import few
from eigengs_dr.image.hilbert import MAX_LEVELS, SQUARE, hilbert_encode, hilbert_squares


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

"""Pieces of a Hilbert curve, beside those of NumPy."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from _helpers.plain_placement import (
    centers,
    curve_order,
    plain_pieces,
    to_canvas,
)
from _helpers.sets import few
from eigengs_dr.fitting.placement.pieces import curve_of, stratify_along_hilbert


def pieces(density, count, backend="llvm"):
    canvas, values = to_canvas(density, backend)
    return centers(*stratify_along_hilbert(canvas, values, count))


@few
@given(height=st.integers(1, 90), width=st.integers(1, 90))
def test_the_curve_visits_tiles_as_a_hilbert_curve_does(backend, height, width):
    canvas, _ = to_canvas(np.zeros((height, width)), backend)
    rank, _ = curve_of(canvas)
    row, column = curve_order(canvas.grid.ny, canvas.grid.nx)
    np.testing.assert_array_equal(np.argsort(rank.numpy()), row * canvas.grid.nx + column)


@few
@given(height=st.integers(1, 40), width=st.integers(1, 40), part=st.floats(0, 1))
def test_pieces_are_those_of_numpy(backend, height, width, part):
    """Also where a pixel holds several of them."""
    density = np.random.default_rng(height).uniform(0, 1, (height, width)) ** 4
    count = max(1, round(part * height * width))
    density *= count / density.sum()
    found = pieces(density, count, backend)
    np.testing.assert_allclose(found, plain_pieces(density.astype(np.float32), count), atol=1e-3)


def test_pieces_of_an_even_density_are_squares(backend):
    """64 centres on 32 x 32 pixels: pieces of the curve are blocks of 4 x 4."""
    mean = pieces(np.full((32, 32), 64 / 1024), 64, backend)
    expected = {(4 * i + 2.0, 4 * j + 2.0) for i in range(8) for j in range(8)}
    assert {tuple(m) for m in np.round(mean, 5).tolist()} == expected


def test_places_without_mass_get_no_piece(backend):
    density = np.zeros((40, 52))
    density[10:20, 30:41] = 0.4
    mean = pieces(density, 44, backend)
    assert ((mean > [30, 10]) & (mean < [41, 20])).all()

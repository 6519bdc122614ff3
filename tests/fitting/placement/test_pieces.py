"""Pieces of a Hilbert curve, and the Lloyd step, beside those of NumPy and SciPy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from _helpers.plain_placement import (
    centers,
    curve_order,
    plain_lloyd,
    plain_pieces,
    to_canvas,
)
from _helpers.sets import few
from eigengs_dr.backend.arrays import upload_rows
from eigengs_dr.fitting.placement.pieces import curve_of, lloyd_step, stratify_along_hilbert


def pieces(density, count, backend="llvm", shift=0.0):
    canvas, values = to_canvas(density, backend)
    shift = canvas.types.Float(shift)
    return centers(*stratify_along_hilbert(canvas, values, count, shift))


def relaxed(mean, density, backend="llvm", spacing=None):
    canvas, values = to_canvas(density, backend)
    rows = upload_rows(canvas.types.Float, np.transpose(mean))
    spacing = spacing or np.sqrt(density.size / len(mean))
    return centers(*lloyd_step(canvas, tuple(rows), values, spacing))


@few
@given(height=st.integers(1, 90), width=st.integers(1, 90))
def test_the_curve_visits_tiles_as_a_hilbert_curve_does(backend, height, width):
    canvas, _ = to_canvas(np.zeros((height, width)), backend)
    rank, _ = curve_of(canvas)
    row, column = curve_order(canvas.grid.ny, canvas.grid.nx)
    np.testing.assert_array_equal(np.argsort(rank.numpy()), row * canvas.grid.nx + column)


@few
@given(
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    part=st.floats(0, 1),
    shift=st.sampled_from([0, 0.3]),
)
def test_pieces_are_those_of_numpy(backend, height, width, part, shift):
    """Also where a pixel holds several of them, and with all cuts but the ends moved back."""
    density = np.random.default_rng(height).uniform(0, 1, (height, width)) ** 4
    count = max(1, round(part * height * width))
    density *= count / density.sum()
    expected = plain_pieces(density.astype(np.float32), count, shift)
    np.testing.assert_allclose(pieces(density, count, backend, shift), expected, atol=1e-3)


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


@few
@given(
    height=st.integers(1, 50),
    width=st.integers(1, 50),
    count=st.integers(1, 60),
    seed=st.integers(0, 99),
)
def test_centroids_are_those_of_a_search_tree(backend, height, width, count, seed):
    generator = np.random.default_rng(seed)
    pixel = generator.permutation(height * width)[:count]
    mean = np.stack(np.divmod(pixel, width)[::-1], 1) + generator.uniform(0.1, 0.9, (len(pixel), 2))
    density = generator.uniform(0, 1, (height, width))
    y, x = np.indices(density.shape).reshape(2, -1)
    away, _ = cKDTree(np.floor(mean) + 0.5).query(np.stack([x, y], 1) + 0.5, min(2, len(mean)))
    if len(mean) > 1:  # either of two may get a pixel
        density.flat[away[:, 0] == away[:, 1]] = 0
    found = relaxed(mean, density, backend, spacing=20)
    np.testing.assert_allclose(found, plain_lloyd(mean.astype(np.float32), density), atol=1e-4)


def test_centres_in_one_pixel(backend):
    """The last of them moves, the others stay: none is lost and none is NaN."""
    start = np.array([[2.5, 0.5], [2.6, 0.5], [2.7, 0.5]])
    mean = relaxed(start, np.full((1, 10), 0.3), backend, spacing=4)
    np.testing.assert_allclose(mean, [[2.5, 0.5], [2.6, 0.5], [5, 0.5]], rtol=1e-6)


@pytest.mark.parametrize("spacing", [1, 30])
def test_pixels_far_from_every_centre_do_not_count(backend, spacing):
    """A key holds distances up to 63."""
    mean = relaxed([[0.5, 0.5]], np.full((1, 200), 0.1), backend, spacing)
    assert 0.5 < mean[0, 0] <= 32 and np.isfinite(mean).all()

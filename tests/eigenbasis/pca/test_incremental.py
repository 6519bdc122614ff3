"""Merging blocks of images into principal components."""

import numpy as np

from _helpers.low_rank import PIXELS, SIZE, family, planes
from eigengs_dr.eigenbasis.pca import incremental
from eigengs_dr.eigenbasis.pca.incremental import empty_state, merge, merge_states


def test_rows_stay_orthonormal_when_variances_differ_much():
    """What rounding mixes into small components is as large as they are."""
    rng = np.random.default_rng(0)
    spread = np.logspace(-1, -4.5, 30)
    directions = np.linalg.qr(rng.normal(size=(PIXELS, 30)))[0].T * np.sqrt(PIXELS)
    images = 0.5 + (rng.normal(size=(200, 30)) * spread) @ directions
    state = empty_state(SIZE)
    for block in np.split(images.astype(np.float32), 8):
        state = merge(state, block, 40)
        overlap = state.rows.astype(np.float64) @ state.rows.T.astype(np.float64)
        assert np.abs(overlap - np.eye(len(state.rows))).max() < 1e-5


def test_merging_nothing_changes_nothing():
    none = empty_state(SIZE)
    state = merge(none, planes(family(5))[:, 0], 4)
    assert merge(state, np.zeros((0, PIXELS), np.float32), 4) is state
    assert merge_states(state, none, 4) is merge_states(none, state, 4) is state


def test_few_eigenvalues_are_those_of_all():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(80, 100)) * 0.9 ** np.arange(100)
    all_values = np.linalg.eigvalsh(rows @ rows.T)[::-1]
    for most in (5, 40):
        values, weights = incremental.largest_eigenpairs(rows @ rows.T, most, 0)
        np.testing.assert_allclose(values, all_values[:most])
        np.testing.assert_allclose(weights.T @ rows @ rows.T @ weights, np.eye(most), atol=1e-9)

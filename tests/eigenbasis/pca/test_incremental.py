"""Merging blocks of images into principal components."""

import numpy as np

from _helpers.low_rank import PIXELS, SIZE
from eigengs_dr.eigenbasis.pca.incremental import empty_state, merge


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

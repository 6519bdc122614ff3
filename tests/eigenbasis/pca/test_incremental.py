"""Merging blocks of images into principal components."""

import numpy as np
import pytest

from _helpers.low_rank import PIXELS, SIZE, assert_same, family, planes
from eigengs_dr.eigenbasis.pca import incremental
from eigengs_dr.eigenbasis.pca.basis import Eigenbasis
from eigengs_dr.eigenbasis.pca.incremental import EigenState, empty_state, merge
from eigengs_dr.image.folder import read_blocks


def test_rows_stay_orthonormal_when_variances_differ_much():
    """What rounding mixes into small components is as large as they are."""
    rng = np.random.default_rng(0)
    spread = np.logspace(-1, -4.5, 30)
    directions = np.linalg.qr(rng.normal(size=(PIXELS, 30)))[0].T * np.sqrt(PIXELS)
    images = 0.5 + (rng.normal(size=(200, 30)) * spread) @ directions
    state = empty_state(SIZE)
    for block in np.split(np.repeat(images[:, None], 3, axis=1).astype(np.float32), 8):
        state = merge(state, block, (40,) * 3)
        for rows in state.rows:
            overlap = rows.astype(np.float64) @ rows.T.astype(np.float64)
            assert np.abs(overlap - np.eye(len(rows))).max() < 1e-5


def test_merging_can_stop_and_go_on(tmp_path):
    images, rank = family(40), (6, 6, 6)
    whole, part = empty_state(SIZE, seed=3), empty_state(SIZE, seed=3)
    for block in read_blocks(images, SIZE, "ycbcr", 8):
        whole = merge(whole, block, rank)
    for block in read_blocks(images[:16], SIZE, "ycbcr", 8):
        part = merge(part, block, rank)
    np.savez(tmp_path / "state.npz", **part.arrays())
    with np.load(tmp_path / "state.npz") as file:
        part = EigenState.from_arrays(dict(file))
    for block in read_blocks(images[16:], SIZE, "ycbcr", 8):
        part = merge(part, block, rank)
    assert part.count == 40
    assert_same(Eigenbasis.from_state(part, SIZE, 5), Eigenbasis.from_state(whole, SIZE, 5))


def test_merging_nothing_changes_nothing():
    state = merge(empty_state(SIZE), planes(family(5)), (4, 4, 4))
    assert merge(state, np.zeros((0, 3, PIXELS), np.float32), (4, 4, 4)) is state
    with pytest.raises(ValueError, match="no images were merged; merge"):
        Eigenbasis.from_state(empty_state(SIZE), SIZE)


def test_merge_leaves_the_old_state_alone():
    state = merge(empty_state(SIZE), planes(family(10)), (4, 4, 4))
    before = {key: array.copy() for key, array in state.arrays().items()}
    merge(state, planes(family(10, seed=1)), (4, 4, 4))
    for key, array in state.arrays().items():
        np.testing.assert_array_equal(array, before[key])


def test_every_image_is_drawn_with_the_same_probability():
    block = np.zeros((64, 3, 1), np.float32) + np.arange(64, dtype=np.float32)[:, None, None]
    drawn = [
        np.stack(incremental.draw_examples([], block, 0, seed))[:, 0, 0] for seed in range(400)
    ]
    counts = np.bincount(np.concatenate(drawn).astype(int), minlength=64)
    # Expected 100 each, with a standard deviation of 8.7.
    assert np.abs(counts - 100).max() < 40


def test_block_length_keeps_to_its_memory():
    assert incremental.block_length((256, 256)) == 1024
    assert incremental.block_length((512, 512)) == 256
    assert incremental.block_length((64, 64)) == 1024
    assert incremental.block_length((1 << 14, 1 << 14)) == 1
    assert [incremental.rank_for(k) for k in (0, 1, 300)] == [0, 2, 375]


def test_few_eigenvalues_are_those_of_all():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(80, 100)) * 0.9 ** np.arange(100)
    all_values = np.linalg.eigvalsh(rows @ rows.T)[::-1]
    for most in (5, 40):
        values, weights, dropped = incremental.largest_eigenpairs(rows @ rows.T, most, 0)
        np.testing.assert_allclose(values, all_values[:most])
        np.testing.assert_allclose(dropped, all_values[most])
        np.testing.assert_allclose(weights.T @ rows @ rows.T @ weights, np.eye(most), atol=1e-9)

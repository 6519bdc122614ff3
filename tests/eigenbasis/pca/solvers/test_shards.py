"""PCA in shards: against scikit-learn, the bound on what merges lose, resuming, any order."""

from contextlib import suppress

import numpy as np
import pytest
from sklearn.decomposition import PCA

from _helpers.low_rank import SIZE, assert_same, family, planes
from eigengs_dr.backend.executor import Done, executor_for
from eigengs_dr.eigenbasis.pca.basis import Eigenbasis
from eigengs_dr.eigenbasis.pca.solvers import incremental_pca as incremental
from eigengs_dr.eigenbasis.pca.solvers import shards
from eigengs_dr.eigenbasis.pca.solvers.incremental_pca import (
    EigenState,
    empty_state,
    merge,
    merge_states,
)
from eigengs_dr.eigenbasis.pca.solvers.shards import ShardOptions, shard_states
from eigengs_dr.image.io import ImageError, save_image


@pytest.fixture(autouse=True)
def small_shards(monkeypatch):
    """Shards of 20 images in blocks of 5."""
    monkeypatch.setattr(shards, "SHARD", 20)
    monkeypatch.setattr(incremental, "MAX_BLOCK", 20)


class Backwards:
    """An executor that ends tasks in the wrong order, and stops after some."""

    workers = 3

    def __init__(self, stop=None):
        self.stop = stop
        self.done = []

    def map(self, function, tasks, shared=None, at_once=None):
        for index, task in reversed(list(enumerate(tasks))):
            if self.stop is not None and len(self.done) >= self.stop:
                raise KeyboardInterrupt
            self.done.append(function.__name__)
            yield Done(index, function(task, shared))


def options(rank=25, folder=None):
    return ShardOptions(SIZE, "ycbcr", (rank,) * 3, 0, 5, folder)


def test_components_are_those_of_scikit_learn():
    """Of a family whose rank no merge has to cut."""
    images = family(110, noise=0)
    basis = Eigenbasis.from_images(images, SIZE, 16)
    for c in range(3):
        channel = planes(images)[:, c].astype(np.float64)
        reference = PCA(16).fit(channel)
        np.testing.assert_allclose(basis.mean[c].ravel(), channel.mean(axis=0), atol=1e-6)
        values = reference.explained_variance_ * 109 / 110
        np.testing.assert_allclose(basis.eigenvalues[c], values, rtol=1e-4, atol=1e-7)
        overlap = reference.components_ @ basis.components[c].reshape(16, -1).T
        np.testing.assert_allclose(np.abs(np.diag(overlap)), 1, atol=1e-4)
    assert basis.count == 110


@pytest.mark.parametrize("rank", [10, 20])
def test_what_merges_lose_is_bounded(rank):
    """Of noise, whose variances hardly fall: the worst case."""
    images = family(130, noise=0.05)
    state = shard_states(images, options(rank), executor_for())
    assert (state.lost > 0).all()
    for c in range(3):
        channel = planes(images)[:, c].astype(np.float64)
        exact = np.linalg.svd(channel - channel.mean(axis=0), compute_uv=False)[:rank] ** 2
        short = exact - state.scatter[c]
        assert (short >= -1e-5 * exact[0]).all() and (short <= state.lost[c]).all()
        np.testing.assert_allclose(state.squares[c], channel.var(axis=0).sum() * 130, rtol=1e-4)


@pytest.mark.parametrize("count", [21, 40, 59, 61, 101, 139])
def test_the_order_of_the_work_changes_no_bit(count, tmp_path):
    images = family(count)
    here = shard_states(images, options(), executor_for())
    far = shard_states(list(images), options(folder=tmp_path), Backwards())
    assert here.count == far.count == count
    for key, array in here.arrays().items():
        np.testing.assert_array_equal(far.arrays()[key], array, key)
    assert len(list(tmp_path.iterdir())) == 3  # the last state of each channel


def test_one_shard_is_one_stream():
    images = family(20)
    state = empty_state(SIZE)
    for block in np.split(planes(images), 4):
        state = merge(state, block, (25,) * 3)
    found = shard_states(images, options(), executor_for())
    for key, array in state.arrays().items():
        np.testing.assert_array_equal(found.arrays()[key], array, key)


@pytest.mark.parametrize("stop", [0, 2, 5, 8, 9, 11, 13])
def test_a_run_that_stopped_continues(tmp_path, stop):
    """Five shards, and four merges of three channels."""
    images = family(100)
    whole = shard_states(images, options(), executor_for())
    first, second = Backwards(stop), Backwards()
    with suppress(KeyboardInterrupt):
        shard_states(images, options(folder=tmp_path), first)
    found = shard_states(images, options(folder=tmp_path), second)
    for key, array in whole.arrays().items():
        np.testing.assert_array_equal(found.arrays()[key], array, key)
    assert len(first.done) == stop and len(first.done + second.done) == 5 + 4 * 3


def test_states_of_nothing_change_nothing():
    state = merge(empty_state(SIZE), planes(family(5)), (4, 4, 4))
    assert merge_states(state, empty_state(SIZE), (4, 4, 4)) is state
    assert merge_states(empty_state(SIZE), state, (4, 4, 4)) is state


def test_examples_come_from_all_shards():
    images = family(100)
    basis = Eigenbasis.from_images(images, SIZE, 2, space="rgb")
    assert basis.examples.shape == (16, SIZE[1], SIZE[0], 3)
    places = [int(np.abs(images - example).sum((1, 2, 3)).argmin()) for example in basis.examples]
    assert len(set(places)) == 16 and len({place // 20 for place in places}) >= 3


def test_files_that_cannot_be_read_are_left_out(tmp_path):
    for i, image in enumerate(family(60)):
        if 20 <= i < 40 or i == 3:  # a whole shard
            (tmp_path / f"{i:03d}.png").write_text("no image")
        else:
            save_image(tmp_path / f"{i:03d}.png", image)
    with pytest.warns(UserWarning) as caught:
        basis = Eigenbasis.from_images(tmp_path, SIZE, 4)
    assert basis.count == 39
    said = [str(note.message) for note in caught]
    assert any("none of 20 images can be read" in text for text in said)
    assert any("1 of 20 images were skipped: 003.png" in text for text in said)
    for path in tmp_path.iterdir():
        path.write_text("no image")
    with pytest.warns(UserWarning), pytest.raises(ImageError, match="none of 60 images"):
        Eigenbasis.from_images(tmp_path, SIZE, 4)


def test_a_dask_array_is_read_part_by_part():
    array = pytest.importorskip("dask.array")
    images = family(70)
    read = []

    def part(block_info=None):
        first, last = block_info[None]["array-location"][0]
        read.append((first, last))
        return images[first:last]

    lazy = array.map_blocks(
        part, chunks=((10,) * 7, SIZE[1], SIZE[0], 3), dtype=np.float32, meta=images[:0]
    )
    expected = Eigenbasis.from_images(images, SIZE, 8)
    assert_same(Eigenbasis.from_images(lazy, SIZE, 8), expected)
    assert len(read) >= 7 and max(last - first for first, last in read) == 10
    rows = array.from_array(images.reshape(70, -1), chunks=(10, -1))
    assert_same(Eigenbasis.from_images(rows, SIZE, 8), expected)
    few = Eigenbasis.from_images(rows[:15], SIZE, 8)
    assert_same(few, Eigenbasis.from_images(images[:15], SIZE, 8))
    with pytest.raises(ValueError, match=r"rows have 462 numbers; RGB of 8x8 has 192"):
        Eigenbasis.from_images(rows, (8, 8), 8)


def test_older_checkpoints_have_no_bound():
    arrays = empty_state(SIZE).arrays()
    del arrays["lost"]
    assert EigenState.from_arrays(arrays).lost.tolist() == [0, 0, 0]

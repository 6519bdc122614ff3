"""PCA in shards: against scikit-learn, the bound on what merges lose, resuming, any order."""

from contextlib import suppress

import numpy as np
import pytest
from sklearn.decomposition import PCA

from _helpers.low_rank import SIZE, family, planes
from eigengs_dr.backend.executor import Done
from eigengs_dr.eigenbasis.pca import incremental, stream
from eigengs_dr.eigenbasis.pca.basis import Eigenbasis
from eigengs_dr.eigenbasis.pca.incremental import EigenState, empty_state, merge, merge_states
from eigengs_dr.eigenbasis.pca.stream import PCAOptions, find_state
from eigengs_dr.image.io import ImageError, save_image


@pytest.fixture(autouse=True)
def small_shards(monkeypatch):
    """Shards of 20 images in blocks of 5."""
    monkeypatch.setattr(stream, "SHARD", 20)
    monkeypatch.setattr(incremental, "MAX_BLOCK", 20)


class Backwards:
    """An executor that ends tasks in the wrong order, and stops after some."""

    workers = 3

    def __init__(self, stop=None):
        self.stop = stop
        self.done = []

    def map(self, function, tasks, shared=None):
        for task in reversed(list(tasks)):
            if self.stop is not None and len(self.done) >= self.stop:
                raise KeyboardInterrupt
            self.done.append(function.__name__)
            yield Done(task, function(task, shared))


def options(components=20):
    return PCAOptions(SIZE, "ycbcr", (components,) * 3, 0)


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


@pytest.mark.parametrize("components", [8, 16])
def test_what_merges_lose_is_bounded(components):
    """Of noise, whose variances hardly fall: the worst case."""
    images = family(130, noise=0.05)
    state, rank = find_state(images, options(components)), incremental.rank_for(components)
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
    here = find_state(images, options())
    far = find_state(list(images), options(), client=Backwards(), checkpoint=tmp_path)
    assert here.count == far.count == count
    for key, array in here.arrays().items():
        np.testing.assert_array_equal(far.arrays()[key], array, key)
    assert len(list(tmp_path.iterdir())) == 3  # the last state of each channel


def test_one_shard_is_one_stream():
    images = family(20)
    state = merge(empty_state(SIZE), planes(images), (25,) * 3)
    for client in (None, Backwards()):
        found = find_state(images, options(), client=client)
        for key, array in state.arrays().items():
            np.testing.assert_array_equal(found.arrays()[key], array, key)


@pytest.mark.parametrize("stop", [0, 2, 4, 5])
def test_a_run_that_stopped_continues(tmp_path, stop):
    images = family(100)
    whole = find_state(images, options())
    first, second = Backwards(stop), Backwards()
    with suppress(KeyboardInterrupt):
        find_state(images, options(), client=first, checkpoint=tmp_path)
    found = find_state(images, options(), client=second, checkpoint=tmp_path)
    for key, array in whole.arrays().items():
        np.testing.assert_array_equal(found.arrays()[key], array, key)
    assert len(first.done) == stop and len(first.done + second.done) == 5


@pytest.mark.parametrize("call", [25, 45, 99])
def test_a_run_that_stopped_between_merges_continues(tmp_path, call):
    """The sum of the first shards is there, and is not made again."""
    images, seen = family(100), []
    whole = find_state(images, options())

    def progress(done, total, row):
        seen.append(done)
        if len(seen) == call:
            raise KeyboardInterrupt

    with suppress(KeyboardInterrupt):
        find_state(images, options(), progress, checkpoint=tmp_path)
    assert seen == list(range(1, call + 1))
    found = find_state(images, options(), lambda done, *rest: seen.append(done), None, tmp_path)
    assert seen[call] == call // 20 * 20 + 1 and seen[-1] == 100
    for key, array in whole.arrays().items():
        np.testing.assert_array_equal(found.arrays()[key], array, key)


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


def test_parts_of_a_dask_array_are_images():
    array = pytest.importorskip("dask.array")
    images = family(70)
    lazy = array.from_array(images, chunks=(10, *images.shape[1:]))
    found = Eigenbasis.from_images((block.compute() for block in lazy.blocks), SIZE, 8)
    expected = Eigenbasis.from_images(images, SIZE, 8)
    assert found.count == 70
    for c in range(3):
        np.testing.assert_allclose(found.eigenvalues[c], expected.eigenvalues[c], rtol=0.03)


def test_older_checkpoints_have_no_bound():
    arrays = empty_state(SIZE).arrays()
    del arrays["lost"]
    assert EigenState.from_arrays(arrays).lost.tolist() == [0, 0, 0]

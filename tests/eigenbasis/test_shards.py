"""PCA in shards: resuming, any order."""

from contextlib import suppress
from itertools import count

import numpy as np
import pytest

from _helpers.low_rank import SIZE, family
from eigengs_dr.backend.executor import Done
from eigengs_dr.eigenbasis import incremental
from eigengs_dr.eigenbasis.basis import Eigenbasis
from eigengs_dr.eigenbasis.incremental import Stream, find_states
from eigengs_dr.image.io import ImageError, save_image


@pytest.fixture(autouse=True)
def small_shards(blocks_of):
    blocks_of(20, shard=20)


class Backwards:
    """An executor that ends tasks in the wrong order."""

    workers = 3

    def map(self, function, tasks, shared=None):
        for task in reversed(list(tasks)):
            yield Done(task, function(task, shared))


def find(images, components=20, progress=None, **options):
    ranks = [incremental.rank_for(components)] * 3
    stream = Stream(SIZE, "ycbcr", ranks, incremental.block_length(SIZE), progress)
    return find_states(images, stream, **options)


def assert_same_states(first, second):
    np.testing.assert_equal([vars(s) for s in second], [vars(s) for s in first])


@pytest.mark.parametrize("number", [20, 21, 40, 59, 61, 101, 139])
def test_the_order_of_the_work_changes_no_bit(number, tmp_path):
    images = family(number)
    here = find(images)
    far = find(list(images), client=Backwards(), checkpoint=tmp_path)
    assert here[0].count == number
    assert_same_states(here, far)
    assert len(list(tmp_path.iterdir())) == 3  # the last state of each channel


def stop(images, folder, call):
    """End a run in its report of this number."""

    def progress(done, total, row):
        assert (done, total, row) == (next(calls), 100, {})
        if done == call:
            raise KeyboardInterrupt

    folder.mkdir()
    calls = count(1)
    with suppress(KeyboardInterrupt):
        find(images, progress=progress, checkpoint=folder)
    assert next(calls) == call + 1


@pytest.mark.parametrize("call", [25, 45, 99])
def test_a_run_that_stopped_continues(tmp_path, call):
    """The sum of the first shards is there, and is not made again."""
    images, seen = family(100), []
    stop(images, tmp_path / "a", call)
    found = find(images, progress=lambda done, *_: seen.append(done), checkpoint=tmp_path / "a")
    assert (seen[0], seen[-1]) == (call // 20 * 20 + 1, 100)
    assert_same_states(find(images), found)


def test_a_run_that_stopped_between_channels_continues(tmp_path):
    images = family(100)
    stop(images, tmp_path / "a", 25)
    stop(images, tmp_path / "b", 45)
    (tmp_path / "b" / "pca-0.npz").replace(tmp_path / "a" / "pca-0.npz")
    assert_same_states(find(images), find(images, checkpoint=tmp_path / "a"))


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

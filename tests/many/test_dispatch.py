"""Chunks of images by an executor that ends them in any order and may lose them."""

import errno

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.clusters import QUICK, Here, files_of, folder_of_photos
from eigengs_dr.many import run


@pytest.fixture
def photos(tmp_path):
    return folder_of_photos(tmp_path / "photos", 12)


def test_results_are_those_of_this_process(photos, tmp_path):
    seen = []

    def progress(done, total, row):
        seen.append((done, total, row.name))

    rows = eg.fit_many(photos, tmp_path / "far", client=Here(), progress=progress, **QUICK)
    here = eg.fit_many(photos, tmp_path / "here", **QUICK)
    assert files_of(tmp_path / "far") == files_of(tmp_path / "here")
    for row, other in zip(rows, here, strict=True):
        assert (row.name, row.input, row.width) == (other.name, other.input, other.width)
        assert row.psnr_rgb == other.psnr_rgb and row.output.name == other.output.name
        assert row.result is None
    assert [done for done, _, _ in seen] == list(range(1, 13)) and seen[0][1] == 12
    assert [name for _, _, name in seen] != sorted(name for _, _, name in seen)


def test_names_are_those_of_the_user(photos, tmp_path, monkeypatch):
    """Workers run in other folders."""
    monkeypatch.chdir(tmp_path)

    class Elsewhere(Here):
        def map(self, function, tasks, shared=None):
            tasks = list(tasks)
            with monkeypatch.context() as patched:
                patched.chdir("/")
                ended = list(super().map(function, tasks, shared))
            yield from ended

    rows = eg.fit_many("photos", "fits", client=Elsewhere(), **QUICK)
    assert [row.status for row in rows] == ["done"] * 12
    assert str(rows[0].input) == "photos/00.png" and str(rows[0].output) == "fits/00.npz"


def test_images_of_a_lost_chunk_are_done_one_by_one(photos, tmp_path):
    executor = Here(lost=["02"])
    rows = eg.fit_many(photos, tmp_path / "fits", client=executor, **QUICK)
    assert [row.name for row in rows if row.status == "failed"] == ["02"]
    assert rows[2].error == f"{photos / '02.png'}: its worker ended 2 times"
    assert sum(row.status == "done" for row in rows) == 11
    chunk = next(names for names in executor.names if "02" in names)
    assert len(chunk) > 1 and all([name] in executor.names for name in chunk)


def test_a_failure_that_may_pass_is_tried_again(photos, tmp_path, monkeypatch):
    """As a full disk of one worker, and of all."""
    output, full, write = tmp_path / "fits", ["03.npz", "03.npz", "02.npz"], run.write_set

    def write_if_there_is_room(path, *content):
        if path.name in full:
            full.remove(path.name)
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        write(path, *content)

    monkeypatch.setattr(run, "write_set", write_if_there_is_room)
    executor = Here()
    rows = eg.fit_many(photos, output, client=executor, **QUICK)
    assert [row.name for row in rows if row.status == "failed"] == ["03"]
    assert rows[3].error == f"{output / '03.npz'}: No space left on device"
    assert executor.names.count(["03"]) == executor.names.count(["02"]) == 1
    assert len(rows) == 12 and not list(output.glob(".*"))


@pytest.mark.parametrize(
    ("side", "iterations", "longest"), [(4, 0, 6), (64, 10000, 4), (128, 10000, 1)]
)
def test_images_and_steps_decide_the_chunks(side, iterations, longest):
    """Long chunks of little work; the last ones are short, so that all workers end together."""
    images = [np.full((side, side, 3), 0.5, np.float32)] * 32
    again = []
    for _ in range(2):
        executor = Here(lost=[f"{k:06d}" for k in range(32)])  # nothing is fitted
        eg.fit_many(images, client=executor, gaussians=2, iterations=iterations)
        chunks = sorted(names for names in executor.names if len(names) > 1)
        lengths = [len(names) for names in chunks]
        assert max(lengths, default=1) == longest
        assert sorted(lengths, reverse=True) == lengths
        again.append(chunks)
    assert again[0] == again[1]


def test_all_workers_go_on_with_a_run(photos, tmp_path):
    """What is done already, before the rest, makes no chunk longer."""
    files = sorted(photos.iterdir())
    eg.fit_many(files[:8], tmp_path / "fits", **QUICK)
    executor = Here()
    eg.fit_many(photos, tmp_path / "fits", client=executor, **QUICK)
    assert sorted(executor.names) == [["08"], ["09"], ["10"], ["11"]]


def test_warnings_of_workers_are_said_here(tmp_path):
    from PIL import Image

    pixels = np.full((24, 32, 4), 128, np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    with pytest.warns(UserWarning, match="transparent pixels"):
        eg.fit_many([tmp_path / "a.png"], client=Here(), **QUICK)

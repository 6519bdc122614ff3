"""Images by folder, glob and URL."""

import pytest

import eigengs_dr as eg
from _helpers.clusters import QUICK
from _helpers.sets import check_equal
from eigengs_dr.collection.sources import list_sources
from eigengs_dr.image.remote import list_urls


@pytest.fixture
def bucket(photos):
    """The photos in a store behind URLs, with a file that is no image."""
    memory = pytest.importorskip("fsspec").filesystem("memory")
    for path in photos.iterdir():
        memory.pipe(f"/bucket/{path.name}", path.read_bytes())
    memory.pipe("/bucket/notes.txt", b"hello")
    yield memory
    memory.rm("/bucket", recursive=True)


def test_globs(photos, tmp_path):
    (tmp_path / "photos" / "deep").mkdir()
    (photos / "02.png").rename(photos / "deep" / "03.png")
    names = [source.name for source in list_sources(str(tmp_path / "**" / "*.png"))]
    assert names == ["00", "01", "03"]
    with pytest.raises(ValueError, match=r"\*\.jpg: no file has such a name; check the pattern"):
        list_sources(str(photos / "*.jpg"))


def test_a_folder_whose_name_looks_like_a_glob(photos, tmp_path):
    folder = photos.rename(tmp_path / "photos[1]")
    assert len(list_sources(str(folder))) == 3


def test_urls_of_folders_globs_and_files(bucket):
    whole = ["memory:///bucket/00.png", "memory:///bucket/01.png", "memory:///bucket/02.png"]
    assert list_urls("memory://bucket") == whole
    assert list_urls("memory://bucket/0[01].png") == whole[:2]
    assert list_urls("memory://bucket/07.png") == ["memory://bucket/07.png"]
    with pytest.raises(eg.ImageError, match=r"memory://bucket/x\*: holds no images"):
        list_urls("memory://bucket/x*")
    with pytest.raises(eg.ImageError, match="nope://a: cannot be listed"):
        list_urls("nope://a")


def test_images_behind_urls_are_fitted(bucket, photos, tmp_path):
    sources = ["memory://bucket/00.png", "memory://bucket/none.png", "memory://bucket/notes.txt"]
    rows = eg.fit_many(sources, tmp_path / "fits", **QUICK)
    assert [row.status for row in rows] == ["done", "failed", "failed"]
    assert rows[0].name == "00" and rows[0].input == sources[0]
    [alone] = eg.fit_many([photos / "00.png"], **QUICK)
    check_equal(eg.Gaussians.load(rows[0].output), alone.result.gaussians.to_arrays())
    assert rows[1].error.startswith("memory://bucket/none.png: cannot be read (")
    assert rows[2].error.startswith("memory://bucket/notes.txt: not an image")

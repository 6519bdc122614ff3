"""Files and folders that appear in one step, one writer for each, and what killed runs leave."""

import hashlib
import os
import secrets

import pytest

from eigengs_dr.storage.atomic import (
    atomic_folder,
    atomic_write,
    lock_folder,
    lock_output,
    remove_stale,
    require_writable,
)


@pytest.fixture
def target(tmp_path):
    """A file that exists, alone in its folder."""
    path = tmp_path / "x.txt"
    path.write_text("old")
    return path


def names(target):
    return os.listdir(target.parent)


def write_to(path, text="new"):
    with atomic_write(path) as temporary:
        temporary.write_text(text)


def test_readers_see_the_old_file_or_the_new_one(target):
    """Also through a link, which stays, and has the lock of its file."""
    link = target.with_name("link.txt")
    link.symlink_to(target)
    require_writable(target)
    with atomic_write(link) as temporary:
        temporary.write_text("new")
        assert temporary.suffix == ".txt" and temporary.parent == target.parent
        assert target.read_text() == "old"
    assert link.is_symlink() and target.read_text() == "new"
    assert sorted(names(target)) == ["link.txt", "x.txt"]
    with lock_output(link), pytest.raises(OSError, match=r"x\.txt: process"), lock_output(target):
        pass


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such modes")
@pytest.mark.parametrize("mode", [0o600, 0o664])
def test_a_replaced_file_keeps_its_mode(target, mode):
    target.chmod(mode)
    with atomic_write(target) as temporary:
        assert not temporary.stat().st_mode & 0o777 & ~(mode | 0o200)  # nor do others read it now
        temporary.write_text("new")
    assert target.stat().st_mode & 0o777 == mode and target.read_text() == "new"


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_an_output_has_one_run(target, kind):
    path, lock = (target.parent, lock_folder) if kind == "folder" else (target, lock_output)
    with lock(path):
        message = rf"{path}: process {os.getpid()} on .* writes into this {kind}; wait for its end"
        for _ in range(2):
            with pytest.raises(OSError, match=message), lock(path):
                pass
        assert len(names(target)) == 2
    assert names(target) == ["x.txt"]
    with lock(path):
        pass


# --- Links, as in an archive from elsewhere ---


def hashed(name):
    return f".eigengs_dr-{hashlib.sha256(name.encode()).hexdigest()[:16]}.lock"


DOORS = {
    ".lock": lambda folder: lock_folder(folder).__enter__(),
    hashed("out.txt"): lambda folder: lock_output(folder / "out.txt").__enter__(),
    ".eigengs_dr-0.txt.lock": lambda folder: write_to(folder / "out.txt"),
    ".eigengs_dr-0.txt": lambda folder: write_to(folder / "out.txt"),
    ".eigengs_dr-0": lambda folder: atomic_folder(folder / "out").__enter__(),
}
"""What is opened, by the name that somebody else has given to a link."""


@pytest.mark.skipif(os.name == "nt", reason="Windows lets few users make links")
@pytest.mark.parametrize("kind", ["link", "second name", "link to nothing", "own file", "pipe"])
@pytest.mark.parametrize("name", DOORS)
def test_no_link_is_followed(tmp_path, monkeypatch, name, kind):
    """Nor is a file emptied that is not a lock; nobody waits for a pipe."""
    monkeypatch.setattr(secrets, "token_hex", lambda _: "0")
    precious, folder = tmp_path / "thesis.txt", tmp_path / "from elsewhere"
    folder.mkdir()
    precious.write_text("thesis")
    if kind == "second name":
        os.link(precious, folder / name)
    elif kind == "own file":
        (folder / name).write_text("thesis")
    elif kind == "pipe":
        os.mkfifo(folder / name)
    else:
        (folder / name).symlink_to(precious if kind == "link" else tmp_path / "new")
    with pytest.raises(OSError, match=r"is not a lock|is a link|File exists"):
        DOORS[name](folder)
    remove_stale(folder)
    assert precious.read_text() == "thesis" and sorted(os.listdir(tmp_path)) == [
        folder.name,
        precious.name,
    ]
    if kind == "own file" and name.endswith(".lock"):
        assert (folder / name).read_text() == "thesis"


def test_stale_links_go_and_what_they_name_stays(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.txt").write_text("a")
    for name in ("photos", "photos/a.txt"):
        (tmp_path / f".eigengs_dr-{len(name)}").symlink_to(tmp_path / name)
    remove_stale(tmp_path)
    assert os.listdir(tmp_path) == ["photos"]
    assert (tmp_path / "photos" / "a.txt").read_text() == "a"

"""Files that are replaced in one step, and a folder for one run."""

import errno
import os
import time

import pytest

from eigengs_dr.storage.atomic import (
    STALE_SECONDS,
    atomic_write,
    lock_folder,
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


def test_readers_see_the_old_file_or_the_new_one(target):
    require_writable(target)
    assert target.read_text() == "old" and names(target) == ["x.txt"]
    with atomic_write(target) as temporary:
        temporary.write_text("new")
        assert temporary.suffix == ".txt" and temporary.parent == target.parent
        assert target.read_text() == "old"
    assert target.read_text() == "new" and names(target) == ["x.txt"]
    other = target.with_name("other")
    other.touch()
    assert target.stat().st_mode == other.stat().st_mode


def test_a_link_keeps_its_target(target):
    link = target.with_name("link.txt")
    link.symlink_to(target)
    with atomic_write(link) as temporary:
        temporary.write_text("new")
    assert link.is_symlink() and target.read_text() == "new"


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")]
)
def test_a_block_that_fails_leaves_the_old_file(target, error):
    """The system reports a full disk without a name; the error has it."""
    with pytest.raises(type(error)) as found, atomic_write(target) as temporary:
        temporary.write_text("half")
        raise error
    assert target.read_text() == "old" and names(target) == ["x.txt"]
    if isinstance(error, OSError):
        assert found.value.filename == str(target)
        assert "No space left" in str(found.value)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("{}", "is a folder; choose another path"),
        ("/dev/null", "is a device; choose another path"),
        ("s3://bucket/x.npz", "results cannot be written to URLs"),
        ("{}/missing/x.npz", "No such file|cannot create a file in .*missing"),
    ],
)
def test_what_cannot_be_written_is_named(tmp_path, path, message):
    path = path.format(tmp_path)
    with pytest.raises(OSError, match=message) as error, atomic_write(path):
        pass
    assert path in str(error.value)
    with pytest.raises(OSError, match=f"{path}: .*({message})"):
        require_writable(path)
    assert list(tmp_path.iterdir()) == []


def test_old_temporary_files_go(target):
    """Young ones, folders and other names stay."""
    stale = ["." + 16 * "a" + ".npz", "." + 16 * "b" + ".txt"]
    kept = ["." + 16 * "c" + ".npz", ".hidden", "." + 16 * "d"]
    for name in [*stale, *kept[:2]]:
        target.with_name(name).write_text("")
    target.with_name(kept[2]).mkdir()
    for name in [*stale, *kept[1:], "x.txt"]:
        os.utime(target.with_name(name), (0, 0))
    young = target.with_name(kept[0])
    os.utime(young, (time.time() - STALE_SECONDS / 2,) * 2)
    remove_stale(target.parent)
    assert sorted(names(target)) == sorted([*kept, "x.txt"])


def test_a_folder_has_one_run(tmp_path):
    with lock_folder(tmp_path):
        message = rf"process {os.getpid()} on .* writes into this folder; wait"
        with pytest.raises(OSError, match=message), lock_folder(tmp_path):
            pass
        assert os.listdir(tmp_path) == [".lock"]
    assert os.listdir(tmp_path) == []
    with lock_folder(tmp_path):
        pass

"""Folders of unfinished runs that are not what a run left: those of others, of kills, and links."""

import shutil

import numpy as np
import pytest

from eigengs_dr.storage.checkpoint import HEAD, open_checkpoint

SETTINGS = {"size": (4, 3), "steps": np.int64(5)}


@pytest.fixture
def output(tmp_path):
    return tmp_path / "x.npz"


@pytest.fixture
def stopped(output):
    """The folder of a run that was interrupted with work done."""
    with pytest.raises(KeyboardInterrupt), open_checkpoint(output, SETTINGS, ["a"]) as checkpoint:
        checkpoint.save("part", {"values": np.arange(3)})
        raise KeyboardInterrupt
    return checkpoint.folder


@pytest.mark.filterwarnings("ignore:.*run.json is unreadable")
@pytest.mark.parametrize("damage", ["lose head", "cut head", "lose work", "empty"])
def test_a_folder_that_a_kill_left_is_begun_anew(output, stopped, damage):
    if damage == "cut head":
        (stopped / HEAD).write_text('{"settings": {"si')
    elif damage == "empty":
        shutil.rmtree(stopped)
        stopped.mkdir()
    else:
        (stopped / {"lose head": HEAD, "lose work": "part.npz"}[damage]).unlink()
    with open_checkpoint(output, SETTINGS, ["b"]) as checkpoint:
        assert not checkpoint.resumed and checkpoint.files == ["b"]
        assert checkpoint.load("part") is None


def test_a_folder_of_somebody_else_stays(output, stopped):
    (stopped / HEAD).unlink()
    (stopped / "letter.txt").write_text("mine")
    with pytest.raises(ValueError, match="not a readable checkpoint; move it away"):
        open_checkpoint(output, SETTINGS, []).__enter__()
    assert (stopped / "letter.txt").read_text() == "mine"


@pytest.mark.parametrize("name", ["", "part.npz", HEAD])
def test_links_in_a_folder_from_elsewhere(tmp_path, output, stopped, name):
    """A run would write to what they name, or delete it."""
    path, other = stopped / name, tmp_path / "other"
    path.rename(other)
    path.symlink_to(other)
    with pytest.raises(OSError, match="is a link"), open_checkpoint(output, SETTINGS, []):
        pass
    assert path.is_symlink() and other.exists()

"""The folder of an unfinished run: begun anew or resumed, of one run at a time, and deleted."""

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


def test_a_run_goes_on(output, stopped):
    with open_checkpoint(output, SETTINGS, ["b"]) as checkpoint:
        assert checkpoint.resumed and checkpoint.files == ["a"]
        assert checkpoint.load("part")["values"].tolist() == [0, 1, 2]
    assert list(output.parent.iterdir()) == []
    with open_checkpoint(output, SETTINGS, []) as checkpoint:
        assert not checkpoint.resumed and checkpoint.load("part") is None


def test_other_settings(output, stopped):
    with (
        pytest.raises(ValueError, match=r"with steps 5 instead of 6; use its settings, or delete"),
        open_checkpoint(output, SETTINGS | {"steps": 6}, []),
    ):
        pass
    assert (stopped / "part.npz").exists()


def lose_head(folder):
    (folder / HEAD).unlink()


def cut_head(folder):
    (folder / HEAD).write_text('{"settings": {"si')


def lose_work(folder):
    (folder / "part.npz").unlink()


def empty(folder):
    shutil.rmtree(folder)
    folder.mkdir()


@pytest.mark.filterwarnings("ignore:.*run.json is unreadable")
@pytest.mark.parametrize("damage", [lose_head, cut_head, lose_work, empty])
def test_a_folder_that_a_kill_left_is_begun_anew(output, stopped, damage):
    damage(stopped)
    with open_checkpoint(output, SETTINGS, ["b"]) as checkpoint:
        assert not checkpoint.resumed and checkpoint.files == ["b"]
        assert checkpoint.load("part") is None


def test_a_folder_of_somebody_else_stays(output, stopped):
    lose_head(stopped)
    (stopped / "letter.txt").write_text("mine")
    with pytest.raises(ValueError, match="not a readable checkpoint; move it away"):
        open_checkpoint(output, SETTINGS, []).__enter__()
    assert (stopped / "letter.txt").read_text() == "mine"


def test_two_runs_at_once(output):
    with open_checkpoint(output, SETTINGS, []) as checkpoint:
        checkpoint.save("part", {"values": np.arange(3)})
        with (
            pytest.raises(OSError, match=r"x\.npz: process \d+ on .* writes into this file; wait"),
            open_checkpoint(output, SETTINGS, []),
        ):
            pass
        assert checkpoint.holds("part")


@pytest.mark.parametrize("name", ["", "part.npz", HEAD])
def test_links_in_a_folder_from_elsewhere(tmp_path, output, stopped, name):
    """A run would write to what they name, or delete it."""
    path, other = stopped / name, tmp_path / "other"
    path.rename(other)
    path.symlink_to(other)
    with pytest.raises(OSError, match="is a link"), open_checkpoint(output, SETTINGS, []):
        pass
    assert path.is_symlink() and other.exists()

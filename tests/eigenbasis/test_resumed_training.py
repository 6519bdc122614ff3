"""A training that was stopped goes on from its checkpoint, to the same bits."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from _helpers.trainings import checkpoint_of, settings
from eigengs_dr.eigenbasis import training
from eigengs_dr.eigenbasis.pca import stream
from eigengs_dr.eigenbasis.training import Interrupted, train


@pytest.fixture
def in_pieces(monkeypatch):
    """Shards of five images, and a checkpoint of every state of the shapes."""
    monkeypatch.setattr(stream, "SHARD", 5)
    monkeypatch.setattr(training, "SAVE_SECONDS", 0)


def assert_same_models(first, second):
    with np.load(first) as a, np.load(second) as b:
        assert a.files == b.files
        for key in a.files:
            np.testing.assert_array_equal(a[key], b[key], strict=True)


class Killed(Exception):
    pass


def killed_at(stage, call):
    """Progress that ends a training at the n-th report of a stage."""
    seen = []

    def progress(found, done, total):
        seen.append(found)
        if found == stage and seen.count(stage) == call:
            raise Killed

    return progress


def kill(folder, output, stage, call=1, **changed):
    """Train until a stage, and no further."""
    with pytest.raises(Killed):
        train(folder, output, settings(**changed), progress=killed_at(stage, call))
    assert not output.exists()


STOPS = [
    ("components", 1),  # nothing is saved yet
    ("components", 6),  # five images are
    ("components", 15),
    ("components", 7),  # at the last image
    ("weights", 1),
    ("shapes", 2),
    ("shapes", 2),
]
"""Stages at which one run after the other is killed, and which report of it is its last."""


@pytest.mark.parametrize(
    ("changed", "more_stops"),
    [
        ({"iterations": 50}, []),
        ({"iterations": 50, "preset": "eigengs"}, []),
        ({"iterations": 50, "frequency_aware": True}, [("shapes", 3), ("shapes", 2)]),
    ],
    ids=["default", "eigengs", "split"],
)
def test_killed_in_every_stage(folder, output, tmp_path, in_pieces, changed, more_stops):
    train(folder, tmp_path / "whole.npz", settings(**changed))
    for stage, call in [*STOPS, *more_stops, ("measure", 2)]:
        kill(folder, output, stage, call, **changed)
        assert checkpoint_of(output).exists() == ((stage, call) != STOPS[0])
    assert train(folder, output, settings(**changed)).figures["resumed"]
    assert_same_models(tmp_path / "whole.npz", output)
    assert not checkpoint_of(output).exists()


def test_killed_by_the_system(folder, output, tmp_path, in_pieces):
    train(folder, tmp_path / "whole.npz", settings(iterations=40))
    script = f"""
import os, signal
from eigengs_dr.eigenbasis import training
from eigengs_dr.eigenbasis.pca import stream
stream.SHARD, training.SAVE_SECONDS = 5, 0
seen = []
def progress(stage, done, total):
    seen.append(stage)
    if seen.count("shapes") == 3:
        os.kill(os.getpid(), signal.SIGKILL)
training.train(
    {str(folder)!r}, {str(output)!r}, training.{settings(iterations=40)!r}, None, progress)
"""
    process = subprocess.run([sys.executable, "-c", script], cwd=Path(__file__).parents[2])
    assert process.returncode == -signal.SIGKILL
    assert not output.exists()
    assert train(folder, output, settings(iterations=40)).figures["resumed"]
    assert_same_models(tmp_path / "whole.npz", output)


@pytest.mark.parametrize(
    ("stage", "call", "kept"),
    [("components", 1, False), ("components", 8, True), ("weights", 1, True), ("shapes", 2, True)],
)
def test_ctrl_c(folder, output, in_pieces, stage, call, kept):
    seen = []

    def press(found, done, total):
        seen.append(found)
        if found == stage and seen.count(stage) == call:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(Interrupted, match="goes on from here" if kept else "nothing is saved"):
        train(folder, output, settings(iterations=26), progress=press)
    assert checkpoint_of(output).exists() == kept
    assert not output.exists()
    assert train(folder, output, settings(iterations=26)).figures["resumed"] == kept


@pytest.mark.parametrize(
    ("other", "changed", "words"),
    [
        ("photos", {"seed": 1}, "seed 0 instead of 1"),
        ("photos", {"iterations": 25}, "iterations"),
        (".", {}, "folder"),
    ],
)
def test_other_settings_than_the_checkpoint(folder, output, in_pieces, other, changed, words):
    kill(folder, output, "weights", iterations=3)
    (folder.parent / "000.png").write_bytes((folder / "000.png").read_bytes())
    with pytest.raises(ValueError, match=words) as caught:
        train(folder.parent / other, output, settings(**{"iterations": 3, **changed}))
    assert str(checkpoint_of(output)) in str(caught.value)
    assert "delete" in str(caught.value)
    assert train(folder, output, settings(iterations=3)).figures["resumed"]


def test_a_folder_that_grew_meanwhile(folder, output, tmp_path, in_pieces):
    train(folder, tmp_path / "whole.npz", settings())
    kill(folder, output, "components", 8)
    (folder / "000a.png").write_bytes((folder / "003.png").read_bytes())
    with pytest.warns(UserWarning, match="goes on with the 24 that were there"):
        train(folder, output, settings())
    assert_same_models(tmp_path / "whole.npz", output)


@pytest.mark.parametrize(
    ("stage", "call", "name"),
    [
        ("components", 8, "run.json"),
        ("components", 8, "pca-0.npz"),
        ("weights", 1, "basis.npz"),
        ("shapes", 3, "shapes-0.npz"),
    ],
)
def test_damaged_checkpoint(folder, output, in_pieces, stage, call, name):
    kill(folder, output, stage, call, iterations=30)
    file = checkpoint_of(output) / name
    content = file.read_bytes()
    for damaged in (b"", content[: len(content) // 2]):
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"model\.npz\.checkpoint") as caught:
            train(folder, output, settings(iterations=30))
        assert "\n" not in str(caught.value)


def test_a_file_in_place_of_the_checkpoint(folder, output):
    checkpoint_of(output).write_text("mine")
    with pytest.raises(ValueError, match="not a readable checkpoint"):
        train(folder, output, settings())
    assert checkpoint_of(output).read_text() == "mine"


def test_only_unreadable_images_are_left(folder, output, tmp_path, in_pieces):
    for path in sorted(folder.iterdir())[8:]:
        path.write_bytes(b"no picture")
    with pytest.warns(UserWarning, match="skipped"):
        train(folder, tmp_path / "whole.npz", settings())
    kill(folder, output, "components", 12)
    with pytest.warns(UserWarning, match="skipped"):
        train(folder, output, settings())
    assert_same_models(tmp_path / "whole.npz", output)

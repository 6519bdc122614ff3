"""Training: from a folder to a model, whatever the images and settings; it goes on after a stop."""

import os
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from _helpers.photos import SMALL, random_fields
from eigengs_dr.backend.interrupts import Interrupted
from eigengs_dr.eigenbasis import incremental, training
from eigengs_dr.eigenbasis.components import TrainOptions
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.eigenbasis.training import train_model
from eigengs_dr.image.io import ImageError


def settings(**changed):
    return TrainOptions(**{**SMALL, **changed})


def checkpoint_of(output):
    """Where a training keeps what it has."""
    return Path(f"{output}.checkpoint")


def test_end_to_end(folder, output):
    stages = []
    trained = train_model(
        folder,
        output,
        settings(),
        progress=lambda done, total, row: stages.append((row["stage"], done, total)),
    )
    figures = trained.figures
    assert (figures["images"], figures["components"], figures["gaussians"]) == (22, [6] * 3, 60)
    # Components that are as smooth as these are rendered well by 60 splats.
    assert figures["psnr_init"] == pytest.approx(figures["psnr_pca"], abs=0.5)
    assert figures["psnr_solved"] > figures["psnr_pca"] + 5
    assert 0 < figures["pca_seconds"] <= figures["seconds"]
    assert ("components", 22, 22) in stages
    assert [stage for stage, *_ in stages[-3:]] == ["weights", "measure", "measure"]
    assert all(0 <= done <= total for _, done, total in stages)
    assert not checkpoint_of(output).exists()


@pytest.mark.parametrize(
    "changed",
    [
        {"preset": "eigengs", "iterations": 3},
        {"frequency_aware": True},
        {"space": "rgb"},
        {"energy": 0.5},
        {"gaussians": 1024},
    ],
    ids=lambda changed: " ".join(changed),
)
def test_other_settings(folder, output, changed):
    figures = train_model(folder, output, settings(**changed)).figures
    assert figures["psnr_solved"] > figures["psnr_init"] > 15
    assert figures["frequency_aware"] == changed.get("frequency_aware", False)
    assert (figures["components"][0] < 6) == ("energy" in changed)
    EigenGS.load(output)


def test_a_model_that_cannot_be_written(folder, output):
    """The work is kept."""
    output.mkdir()
    with pytest.raises(OSError, match=r"model\.npz"):
        train_model(folder, output, settings())
    assert {path.name for path in output.parent.iterdir()} == {
        "model.npz",
        "model.npz.checkpoint",
        "photos",
    }
    output.rmdir()
    assert train_model(folder, output, settings()).figures["resumed"]


def test_no_folder_to_write_into(folder, tmp_path):
    with pytest.raises(OSError, match="gone"):
        train_model(folder, tmp_path / "gone" / "model.npz", settings())


def test_unreadable_images_are_skipped(folder, output):
    for name in ("003.png", "009.png"):  # one to train on, one held out
        (folder / name).write_bytes(b"no picture")
    with pytest.warns(UserWarning) as notes:
        figures = train_model(folder, output, settings()).figures
    told = [str(note.message) for note in notes]
    assert "1 of 22 images were skipped: 003.png" in told[0]
    assert "1 of 2 held-out images were skipped" in told[1]
    assert figures["images"] == 21
    assert figures["psnr_solved"] > 20


def test_nothing_but_unreadable_images(folder, output):
    for path in folder.iterdir():
        path.write_bytes(b"no picture")
    with pytest.raises(ImageError, match="none of 22 images"):
        train_model(folder, output, settings())
    assert list(output.parent.iterdir()) == [folder]


def test_images_of_other_sizes(folder, output):
    with pytest.warns(UserWarning, match="resized to 20x12"):
        figures = train_model(folder, output, settings(size=(20, 12))).figures
    assert figures["psnr_solved"] > figures["psnr_init"] > 15
    assert EigenGS.load(output).mean_image.shape == (3, 12, 20)


@pytest.mark.parametrize("count", [1, 4])
def test_fewer_splats_than_components(folder, output, count):
    assert train_model(folder, output, settings(gaussians=count)).figures["psnr_solved"] > 10


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"gaussians": 0}, "gaussians is 0"),
        ({"gaussians": 2.5}, "gaussians is 2.5"),
        ({"iterations": -1}, "iterations is -1"),
        ({"iterations": 5}, "iterations is 5; preset 'default' trains nothing"),
        ({"seed": -1}, "seed is -1"),
        ({"preset": "none"}, "preset 'none' is unknown; use one of default, eigengs"),
        ({"preset": "eigengs", "iterations": 0}, "iterations is 0"),
        ({"frequency_aware": "maybe"}, "is 'maybe'; use 'auto', True or False"),
        ({"space": "lab"}, "space 'lab' is unknown; use one of ycbcr, rgb"),
        ({"components": -1}, "components is -1"),
        ({"target_psnr": 20, "energy": 0.9}, "give one of them"),
        ({"target_psnr": np.nan}, "target_psnr is nan"),
    ],
    ids=str,
)
def test_wrong_settings_are_refused(changed, words):
    """Before an image is read."""
    kind = TypeError if words == "gaussians is 2.5" else ValueError
    with pytest.raises(kind, match=words):
        settings(**changed)


def test_train_to_a_target(trained, tmp_path):
    folder, full = trained
    target = float(full.model.held_out[8]) - 1e-6
    result = train_model(
        folder / "photos", tmp_path / "m.npz", TrainOptions(**SMALL, target_psnr=target)
    )
    counts = result.basis.truncation_curve().counts[-1]
    assert counts.tolist() == full.basis.truncation_curve().counts[8].tolist()
    np.testing.assert_allclose(result.model.held_out, full.model.held_out[:9], atol=1e-6)
    assert result.figures["psnr_pca"] == pytest.approx(target, abs=1e-3)
    assert result.figures["components"] == counts.tolist()


def test_train_without_images_for_a_target(tmp_path):
    photos = random_fields(tmp_path / "few", 5)
    with pytest.raises(ValueError, match="needs held-out images"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        train_model(photos, tmp_path / "m.npz", TrainOptions(**SMALL, target_psnr=20))
    assert [path.name for path in tmp_path.iterdir()] == ["few"]


@pytest.fixture
def in_pieces(monkeypatch):
    """Shards of five images, and a checkpoint of every state of the shapes."""
    monkeypatch.setattr(incremental, "SHARD", 5)
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

    def progress(done, total, row):
        seen.append(row["stage"])
        if row["stage"] == stage and seen.count(stage) == call:
            raise Killed

    return progress


def kill(folder, output, stage, call=1, **changed):
    """Train until a stage, and no further."""
    with pytest.raises(Killed):
        train_model(folder, output, settings(**changed), progress=killed_at(stage, call))
    assert not output.exists()


LONG = {"preset": "eigengs", "iterations": 50}
"""Settings of a training that has several states."""

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
        ({}, []),
        ({"frequency_aware": True}, [("shapes", 3), ("shapes", 2)]),
    ],
    ids=["eigengs", "split"],
)
def test_killed_in_every_stage(folder, output, tmp_path, in_pieces, changed, more_stops):
    changed = changed | LONG
    train_model(folder, tmp_path / "whole.npz", settings(**changed))
    for stage, call in [*STOPS, *more_stops, ("measure", 2)]:
        kill(folder, output, stage, call, **changed)
        assert checkpoint_of(output).exists() == ((stage, call) != STOPS[0])
    assert train_model(folder, output, settings(**changed)).figures["resumed"]
    assert_same_models(tmp_path / "whole.npz", output)
    assert not checkpoint_of(output).exists()


def test_killed_by_the_system(folder, output, tmp_path, in_pieces):
    train_model(folder, tmp_path / "whole.npz", settings(**LONG))
    script = f"""
import os, signal
from eigengs_dr.eigenbasis import incremental, training
incremental.SHARD, training.SAVE_SECONDS = 5, 0
seen = []
def progress(done, total, row):
    seen.append(row["stage"])
    if seen.count("shapes") == 3:
        os.kill(os.getpid(), signal.SIGKILL)
training.train_model(
    {str(folder)!r}, {str(output)!r}, training.{settings(**LONG)!r}, None, progress)
"""
    process = subprocess.run([sys.executable, "-c", script], cwd=Path(__file__).parents[2])
    assert process.returncode == -signal.SIGKILL
    assert not output.exists()
    assert train_model(folder, output, settings(**LONG)).figures["resumed"]
    assert_same_models(tmp_path / "whole.npz", output)


@pytest.mark.parametrize(
    ("stage", "call", "kept"),
    [("components", 1, False), ("components", 8, True), ("weights", 1, True), ("shapes", 2, True)],
)
def test_ctrl_c(folder, output, in_pieces, stage, call, kept):
    seen = []

    def press(done, total, row):
        seen.append(row["stage"])
        if row["stage"] == stage and seen.count(stage) == call:
            os.kill(os.getpid(), signal.SIGINT)

    advice = "repeat the command to continue" if kept else "nothing is saved"
    with pytest.raises(Interrupted, match=advice) as stopped:
        train_model(folder, output, settings(**LONG), progress=press)
    assert stopped.value.result == (checkpoint_of(output) if kept else None)
    assert checkpoint_of(output).exists() == kept
    assert not output.exists()
    assert train_model(folder, output, settings(**LONG)).figures["resumed"] == kept


def test_other_settings_than_the_checkpoint(folder, output, in_pieces):
    kill(folder, output, "weights", **LONG)
    (folder.parent / "000.png").write_bytes((folder / "000.png").read_bytes())
    for other, changed, words in (
        ("photos", {"seed": 1}, "seed 0 instead of 1"),
        ("photos", {"iterations": 25}, "iterations"),
        (".", {}, "folder"),
    ):
        with pytest.raises(ValueError, match=words) as caught:
            train_model(folder.parent / other, output, settings(**{**LONG, **changed}))
        assert str(checkpoint_of(output)) in str(caught.value)
        assert "delete" in str(caught.value)
    assert train_model(folder, output, settings(**LONG)).figures["resumed"]


def test_a_folder_that_grew_meanwhile(folder, output, tmp_path, in_pieces):
    train_model(folder, tmp_path / "whole.npz", settings())
    kill(folder, output, "components", 8)
    (folder / "000a.png").write_bytes((folder / "003.png").read_bytes())
    with pytest.warns(UserWarning, match="the original 24"):
        train_model(folder, output, settings())
    assert_same_models(tmp_path / "whole.npz", output)


@pytest.mark.parametrize(
    ("stage", "call", "name"),
    [
        ("components", 8, "pca-0.npz"),
        ("weights", 1, "basis.npz"),
        ("shapes", 3, "shapes-0.npz"),
    ],
)
def test_damaged_checkpoint(folder, output, in_pieces, stage, call, name):
    kill(folder, output, stage, call, **LONG)
    file = checkpoint_of(output) / name
    content = file.read_bytes()
    for damaged in (b"", content[: len(content) // 2]):
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"model\.npz\.checkpoint") as caught:
            train_model(folder, output, settings(**LONG))
        assert "\n" not in str(caught.value)


def test_a_file_in_place_of_the_checkpoint(folder, output):
    checkpoint_of(output).write_text("mine")
    with pytest.raises(ValueError, match="not a readable checkpoint"):
        train_model(folder, output, settings())
    assert checkpoint_of(output).read_text() == "mine"


def test_only_unreadable_images_are_left(folder, output, tmp_path, in_pieces):
    for path in sorted(folder.iterdir())[8:]:
        path.write_bytes(b"no picture")
    with pytest.warns(UserWarning, match="skipped"):
        train_model(folder, tmp_path / "whole.npz", settings())
    kill(folder, output, "components", 12)
    with pytest.warns(UserWarning, match="skipped"):
        train_model(folder, output, settings())
    assert_same_models(tmp_path / "whole.npz", output)

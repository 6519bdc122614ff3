"""Training by the command: whatever the images and settings; it goes on after a stop."""

import json
import os
import shutil
import signal
import subprocess
import time

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import SMALL, assert_refused, run, succeeded
from _helpers.photos import random_fields
from _helpers.process import start

LONG = (*SMALL, "--preset", "eigengs", "--iterations", 1500)
"""A training that takes seconds."""


@pytest.fixture
def folder(tmp_path):
    return random_fields(tmp_path / "photos", 24)


def train(folder, *options):
    """Train a model beside the folder; return the report, the result and the model."""
    output, report = folder.parent / "m.npz", folder.parent / "m.json"
    words = ("train", folder, "-o", output, "--report", report, *SMALL, *options)
    result = succeeded(run(*words))
    return json.loads(report.read_text()), result, eg.EigenGS.load(output)


# --- Images and settings ---


def test_end_to_end(folder):
    report, _, model = train(folder)
    assert (report["images"], report["components"], report["gaussians"]) == (22, [6] * 3, 60)
    # Components that are as smooth as these are rendered well by 60 splats.
    assert report["psnr_init"] == pytest.approx(report["psnr_pca"], abs=0.5)
    assert report["psnr_solved"] > report["psnr_pca"] + 5
    assert len(model.held_out) == 19
    assert model.held_out[-1] == pytest.approx(report["psnr_pca"], abs=1e-3)
    assert sorted(path.name for path in folder.parent.iterdir()) == ["m.json", "m.npz", "photos"]


@pytest.mark.parametrize(
    "options",
    [
        ("--preset", "eigengs", "--iterations", 3),
        ("--frequency-aware", "yes"),
        ("--space", "rgb"),
        ("--energy", 0.5, "--components", "6,5,4", "--seed", 3),
        ("--gaussians", 1024),
        ("--gaussians", 1),
    ],
    ids=lambda options: " ".join(map(str, options)),
)
def test_other_settings(folder, options):
    report = train(folder, *options)[0]
    assert report["psnr_solved"] > 10
    assert report["psnr_solved"] > report["psnr_init"] > 15 or "1" in map(str, options)
    assert report["frequency_aware"] == ("yes" in options)
    assert (report["components"][0] < 6) == ("--energy" in options)
    assert report["most_components"] == ([6, 5, 4] if "--seed" in options else 6)
    assert report["seed"] == (3 if "--seed" in options else 0)


def test_images_of_other_sizes_and_unreadable_ones(folder):
    for name in ("003.png", "009.png"):  # one to train on, one held out
        (folder / name).write_bytes(b"no picture")
    report, result, model = train(folder, "--size", "20x12")
    assert "1 of 22 images were skipped: 003.png" in result.stderr
    assert "1 of 2 held-out images were skipped" in result.stderr
    assert "resized to 20x12" in result.stderr
    assert report["images"] == 21
    assert report["psnr_solved"] > report["psnr_init"] > 15
    assert model.mean_image.shape == (3, 12, 20)


def test_a_target_needs_held_out_images(tmp_path):
    photos = random_fields(tmp_path / "few", 5)
    result = run("train", photos, "-o", tmp_path / "m.npz", *SMALL, "--target-psnr", 20)
    assert result.exit_code == 2 and "needs held-out images" in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["few"]


# --- Stops ---


def stop(folder, sent, *options, file="basis.npz", wait=0.5):
    """Send a signal to a training, soon after a file is in its checkpoint."""
    output = folder.parent / "m.npz"
    with start("train", folder, "-o", output, *options, stderr=subprocess.PIPE) as process:
        while process.poll() is None and not (folder.parent / "m.npz.checkpoint" / file).exists():
            time.sleep(0.005)
        time.sleep(wait)
        process.send_signal(sent)
        stderr = process.communicate()[1]
    assert not output.exists()
    return process.returncode, stderr


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A folder of photos and the model of a training that nothing stopped."""
    work = tmp_path_factory.mktemp("whole")
    folder = random_fields(work / "photos", 24)
    succeeded(run("train", folder, "-o", work / "m.npz", *LONG))
    return work


@pytest.fixture(scope="module")
def interrupted(whole):
    """A copy whose training Ctrl-C stopped while it trained the shapes."""
    work = whole.parent / "work"
    shutil.copytree(whole / "photos", work / "photos")
    code, stderr = stop(work / "photos", signal.SIGINT, *LONG)
    assert code == 130 and stderr.endswith("interrupted; repeat the command to continue\n")
    return work.rename(whole.parent / "interrupted")


@pytest.fixture
def stopped(interrupted):
    """That copy, where it was stopped."""
    work = interrupted.parent / "work"
    yield shutil.copytree(interrupted, work)
    shutil.rmtree(work)


def go_on(work, *options):
    return run("train", work / "photos", "-o", work / "m.npz", *LONG, *options)


def assert_same_models(first, second):
    with np.load(first) as a, np.load(second) as b:
        assert a.files == b.files
        for key in a.files:
            np.testing.assert_array_equal(a[key], b[key], strict=True)


def test_a_stopped_training_goes_on_with_the_same_bits(whole, stopped):
    (stopped / "photos" / "000a.png").write_bytes((stopped / "photos" / "003.png").read_bytes())
    result = succeeded(go_on(stopped, "--report", stopped / "m.json"))
    assert "the original 24" in result.stderr  # the folder grew meanwhile
    assert json.loads((stopped / "m.json").read_text())["resumed"]
    assert_same_models(whole / "m.npz", stopped / "m.npz")
    assert not (stopped / "m.npz.checkpoint").exists()


def test_other_settings_than_the_checkpoint_are_refused(stopped):
    for options, words in (
        (("--seed", 1), "seed 0 instead of 1"),
        (("--iterations", 25), "iterations"),
    ):
        assert_refused(go_on(stopped, *options), words, stopped / "m.npz.checkpoint", "delete")
    shutil.copytree(stopped / "photos", stopped / "others")
    result = run("train", stopped / "others", "-o", stopped / "m.npz", *LONG)
    assert_refused(result, "folder")


@pytest.mark.parametrize("name", ["basis.npz", "shapes-0.npz"])
def test_a_damaged_checkpoint_is_named(stopped, name):
    file = stopped / "m.npz.checkpoint" / name
    content = file.read_bytes()
    for damaged in (b"", content[: len(content) // 2]):
        file.write_bytes(damaged)
        assert_refused(go_on(stopped), "m.npz.checkpoint")


def test_a_file_in_place_of_the_checkpoint_stays(folder):
    (folder.parent / "m.npz.checkpoint").write_text("mine")
    result = run("train", folder, "-o", folder.parent / "m.npz", *SMALL)
    assert_refused(result, "not a readable checkpoint")
    assert (folder.parent / "m.npz.checkpoint").read_text() == "mine"


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signal")
def test_components_of_many_images_are_not_found_twice(tmp_path):
    """A run that is killed after its first shard of images keeps the sum of that shard."""
    folder, few = tmp_path / "photos", ("--size", "8x8", "--components", 4, "--gaussians", 20)
    random_fields(folder, 4000, size=8)
    code, _ = stop(folder, signal.SIGKILL, *few, file="pca-0.npz", wait=0)
    assert code == -signal.SIGKILL
    assert not (tmp_path / "m.npz.checkpoint" / "basis.npz").exists()
    report = ("--report", tmp_path / "m.json")
    succeeded(run("train", folder, "-o", tmp_path / "m.npz", *few, *report))
    assert json.loads((tmp_path / "m.json").read_text())["resumed"]
    succeeded(run("train", folder, "-o", tmp_path / "whole.npz", *few))
    assert_same_models(tmp_path / "m.npz", tmp_path / "whole.npz")

"""The command `train`."""

import json
import os
import signal
from contextlib import contextmanager

import pytest

from _helpers.command import SMALL, assert_refused, run, said, succeeded
from _helpers.photos import random_fields
from eigengs_dr.cli import train as cli_train


def test_train_says_what_it_did(trained):
    folder, result = trained
    words = ("11 images", "6+6+6 components", "60 Gaussians", "psnr_pca", "psnr_init", "m.png")
    assert all(word in result.stdout for word in words)
    assert result.stdout.count("\n") == 3 and result.stderr == ""
    assert not (folder / "m.npz.checkpoint").exists()


def test_train_report(trained):
    folder, _ = trained
    report = json.loads((folder / "m.json").read_text())
    expected = {"input": str(folder / "photos"), "output": str(folder / "m.npz"), "seed": 0}
    expected |= {"size": [32, 32], "components": [6, 6, 6], "most_components": 6, "energy": None}
    expected |= {"gaussians": 60, "frequency_aware": True, "preset": "default", "space": "ycbcr"}
    assert {key: report[key] for key in expected} == expected
    assert report["command"].startswith("eigengs-dr train ") and not report["resumed"]
    assert report["versions"]["drjit"]
    for key in ("seconds", "pca_seconds", "shape_seconds", "weight_seconds"):
        assert report[key] > 0
    assert report["psnr_solved"] > report["psnr_init"] > 15
    assert report["psnr_init"] == pytest.approx(report["psnr_pca"], abs=1.5)


def test_a_note_is_said_once(tmp_path):
    """Although the folder is listed twice."""
    random_fields(tmp_path / "photos", 3)
    random_fields(tmp_path / "photos" / "more", 1)
    told = succeeded(run("train", tmp_path / "photos", "-o", tmp_path / "m.npz", *SMALL))
    assert told.stderr.count("images in its subfolders are left out") == 1


def test_target_psnr(tmp_path):
    photos = random_fields(tmp_path / "photos", 30)
    report, model = tmp_path / "r.json", tmp_path / "m.npz"
    small = ["--size", "32x32", "--components", 6, "--gaussians", 60, "--target-psnr", 21]
    text = said("train", photos, "-o", model, "--report", report, *small)
    assert " s; not split\n" in text
    figures = json.loads(report.read_text())
    assert figures["target_psnr"] == 21
    assert figures["psnr_held_out"][-1] >= 21 > figures["psnr_held_out"][-2]
    rows = json.loads(said("info", model, "--json"))["truncation"]
    assert rows[0]["components"] == [0, 0, 0] and rows[0]["variance"] == 0
    assert rows[-1]["components"] == figures["components"]
    assert rows[-1]["psnr_held_out"] == pytest.approx(figures["psnr_held_out"][-1], abs=1e-3)
    table = said("info", model).splitlines()[-len(rows) - 1 :]
    assert table[0].split() == ["components", "variance", "training", "held", "out"]
    assert [int(line.split()[0]) for line in table[1:]] == [sum(r["components"]) for r in rows]
    assert f"{figures['psnr_held_out'][-1]:.2f} dB" in table[-1]
    assert len({len(line) for line in table}) == 1


def test_train_without_images_to_hold_out(tmp_path):
    folder = random_fields(tmp_path / "few", 5)
    outputs = ["-o", tmp_path / "m.npz", "--report", tmp_path / "m.json"]
    result = succeeded(run("train", folder, *outputs, *SMALL))
    assert "no image was held out" in result.stdout
    assert "note: 5 images give at most 4 components" in result.stderr
    report = json.loads((tmp_path / "m.json").read_text())
    assert [report[key] for key in ("psnr_pca", "psnr_init", "psnr_solved")] == [None] * 3


def test_train_options(trained, tmp_path):
    expected = {"energy": 0.5, "space": "rgb", "seed": 3, "preset": "eigengs", "iterations": 2}
    options = [word for name, value in expected.items() for word in (f"--{name}", value)]
    outputs = ["-o", tmp_path / "m.npz", "--report", tmp_path / "m.json", "--quiet"]
    size = ["--size", "16x16", "--components", "6,5,4"]
    assert said("train", trained[0] / "photos", *outputs, *size, *options) == ""
    report = json.loads((tmp_path / "m.json").read_text())
    expected |= {"gaussians": 256, "most_components": [6, 5, 4]}  # one Gaussian per pixel
    assert {key: report[key] for key in expected} == expected
    assert max(report["components"]) < 6


def test_train_interrupted_goes_on(trained, tmp_path, monkeypatch):
    @contextmanager
    def presses(quiet):
        def show(stage, done, total):
            if stage == "weights":
                os.kill(os.getpid(), signal.SIGINT)

        yield show

    command = ["train", trained[0] / "photos", "-o", tmp_path / "m.npz", *SMALL]
    with monkeypatch.context() as patched:
        patched.setattr(cli_train, "bar", presses)
        result = run(*command)
    assert result.exit_code == 130
    assert result.stderr == "eigengs-dr: interrupted; repeat the command to continue\n"
    assert result.stdout == ""
    assert [path.name for path in tmp_path.iterdir()] == ["m.npz.checkpoint"]
    assert_refused(run(*command, "--seed", 1), "m.npz.checkpoint", "seed 0", "delete")
    succeeded(run(*command, "--report", tmp_path / "m.json"))
    assert json.loads((tmp_path / "m.json").read_text())["resumed"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m.json", "m.npz"]


MISTAKES = [
    (["--gaussians", 1025, "--size", "32x32"], "gaussians is 1025"),
    (["--components", "3,4"], "3,4: expected a number above 0, or three such as 230,60,60"),
    (["--size", "32"], "such as 1024x768"),
    (["--size", "99999x99999"], "99999x99999"),
    (["-o", "m.png"], ".npz"),
    (["-o", "gone/m.npz"], "gone"),
    (["--report", "gone/r"], "gone"),
    (["--preview", "p.txt"], ".png"),
]


@pytest.mark.parametrize(("options", "word"), MISTAKES)
def test_mistakes(trained, existing, options, word, monkeypatch):
    monkeypatch.chdir(existing.parent)
    before = sorted(existing.parent.iterdir())
    assert_refused(run("train", trained[0] / "photos", "-o", existing, *options), word)
    assert sorted(existing.parent.iterdir()) == before


def test_mistaken_folders(trained, existing, tmp_path):
    photos = trained[0] / "photos"
    assert_refused(run("train", tmp_path / "gone", "-o", existing), "gone")
    assert_refused(run("train", photos / "000.png", "-o", existing), "000.png")
    over = run("train", photos, "-o", existing, "--preview", photos / "000.png")
    assert_refused(over, "000.png", "is read")
    bad = tmp_path / "bad"
    bad.mkdir()
    assert_refused(run("train", bad, "-o", existing), "holds no images")
    (bad / "x.png").write_bytes(b"no picture")
    assert_refused(run("train", bad, "-o", existing, *SMALL), "none of 1", "x.png")
    assert not (tmp_path / "existing.npz.checkpoint").exists()

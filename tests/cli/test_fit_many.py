"""The command `fit` with several images: skipped, failed and interrupted ones."""

import json
import shutil

import pytest

import eigengs_dr as eg
from _helpers.command import run, succeeded
from eigengs_dr.backend import feedback
from eigengs_dr.cli import console
from eigengs_dr.collection import fit_many as fit_many_module

QUICK = ("--gaussians", 20, "--iterations", 1)


@pytest.fixture
def photos(photo, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in ("a.png", "b.png", "c.png"):
        shutil.copy(photo, folder / name)
    return folder


def test_the_same_command_continues(photos, tmp_path):
    fits, report = tmp_path / "fits", tmp_path / "r.json"
    command = ["fit", photos, "-o", fits, "--report", report, *QUICK]
    succeeded(run(*command))
    (fits / "b.npz").unlink()
    result = succeeded(run(*command))
    assert "1 image fitted, 2 skipped" in result.stdout and "--overwrite" in result.stdout
    rows = json.loads(report.read_text())["images"]
    assert [row["stopped"] for row in rows] == ["skipped", "iterations", "skipped"]
    assert rows[1]["psnr_ycbcr"] > rows[1]["psnr_rgb"] and rows[1]["ms_ssim"] > 0
    assert rows[1]["output"] == str(fits / "b.npz") and rows[1]["trace"]
    result = succeeded(run(*command, "--overwrite", "--gaussians", 9))
    assert "3 images fitted in" in result.stdout
    assert len(eg.Gaussians.load(fits / "a.npz")) == 9


def test_ctrl_c_keeps_what_is_done(photos, tmp_path, monkeypatch):
    complete, fitted = fit_many_module.fit_image, []

    def interrupted(*arguments):
        fitted.append(complete(*arguments))
        if len(fitted) == 2:
            raise KeyboardInterrupt
        return fitted[-1]

    monkeypatch.setattr(fit_many_module, "MAX_GROUP_PIXELS", 1)  # every image is a group
    monkeypatch.setattr(fit_many_module, "fit_image", interrupted)
    report = tmp_path / "r.json"
    result = run("fit", photos, "-o", tmp_path / "fits", "--report", report, *QUICK)
    assert result.exit_code == 130
    assert result.stderr == (
        "eigengs-dr: interrupted; 1 of 3 images are done; the same command fits the others\n"
    )
    assert sorted(path.name for path in (tmp_path / "fits").iterdir()) == [
        "a.npz",
        "manifest.jsonl",
    ]
    assert len(json.loads(report.read_text())["images"]) == 1


def test_a_target_out_of_reach(photos, tmp_path):
    limits = ["--target-psnr", 90, "--max-gaussians", 20, "--iterations", 3]
    result = run("fit", photos, "-o", tmp_path / "fits", *limits)
    assert result.exit_code == 1
    assert result.stderr.count("are out of reach") == 3


def test_a_basis_is_no_output(trained, photos):
    model = shutil.copy(trained[0] / "m.npz", photos / "a.npz")
    before = model.read_bytes()
    result = run("fit", photos, "-o", photos, *QUICK)
    assert result.exit_code == 2 and "no set of Gaussians" in result.stderr
    assert model.read_bytes() == before


def test_a_line_stands_above_the_bar(monkeypatch, capsys):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    monkeypatch.setattr(feedback, "DELAY", 0)
    with console.bar(False) as show:
        show("photos", 3, 4, {"psnr_rgb": 31.2})
        console.say("error: x.png: no image")
    said = capsys.readouterr().err
    assert "photos" in said and "eigengs-dr: error: x.png: no image\n" in said

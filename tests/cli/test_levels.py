"""Levels of detail on the command line."""

import json

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import run
from _helpers.photos import coffee
from eigengs_dr.raster.render import picture_of


@pytest.fixture(scope="module")
def image():
    return coffee(48)


def test_commands(image, tmp_path):
    photo, fitted, small = (tmp_path / name for name in ("a.png", "a.npz", "a.egs"))
    eg.save_image(photo, image)
    base = ["fit", photo, "-o", fitted, "--quiet", "--iterations", 10]
    done = run(*base, "--gaussians", 64, "--levels", 2)
    assert done.exit_code == 0, done.stderr
    assert run("pack", fitted, "-o", small, "--levels", 2, "--quiet").exit_code == 0
    told = json.loads(run("info", small, "--json").stdout)
    assert told["sections"] == [16, 48]
    out = tmp_path / "b.png"
    assert run("render", fitted, "-o", out, "--first", 16).exit_code == 0
    refused = run("render", fitted, "-o", out, "--first", 65)
    assert refused.exit_code == 2
    assert "--first is 65; the file has 64 Gaussians" in refused.stderr
    expected = picture_of(eg.Gaussians.load(fitted)[:16]).clip(0, 1)
    assert np.abs(eg.load_image(out) - expected).max() < 0.003


def test_numbers_of_gaussians(image, tmp_path):
    photo, fitted, small, page = (tmp_path / f"a.{end}" for end in ("png", "npz", "egs", "html"))
    eg.save_image(photo, image)
    base = ["fit", photo, "-o", fitted, "--iterations", 5, "--quiet"]
    report = tmp_path / "r.json"
    assert run(*base, "--levels", "16,40,64", "--report", report).exit_code == 0
    assert json.loads(report.read_text())["levels"] == [16, 40, 64]
    assert run("pack", fitted, "-o", small, "--levels", "16,40,64", "--quiet").exit_code == 0
    assert json.loads(run("info", small, "--json").stdout)["sections"] == [16, 24, 24]
    assert run("view", fitted, "-o", page, "--levels", "16,40,64").exit_code == 0
    assert '"levels": [16, 40, 64]' in page.read_text()
    for command in (
        [*base, "--gaussians", 65, "--levels", "16,40,64"],
        ["pack", fitted, "-o", small, "--levels", "16,40"],
        ["view", fitted, "-o", page, "--levels", "40,16,64"],
        [*base, "--levels", "16;40"],
    ):
        refused = run(*command)
        assert refused.exit_code == 2
        assert "16" in refused.stderr.splitlines()[-1]


def test_options_that_levels_exclude(image, tmp_path):
    photo = tmp_path / "a.png"
    eg.save_image(photo, image)
    base = ["fit", photo, "-o", tmp_path / "a.npz", "--quiet"]
    count = ["--gaussians", 64]
    for extra in (["--target-psnr", 30], [*count, "--init", "grid"], [*count, "--levels", 9]):
        refused = run(*base, "--levels", 2, *extra)
        assert refused.exit_code == 2
        assert "levels" in refused.stderr and len(refused.stderr.splitlines()) == 1

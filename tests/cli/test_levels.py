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

    for extra in (["--target-psnr", 30], ["--init", "grid"], ["--levels", 9]):
        refused = run(*base, "--gaussians", 64, "--levels", 2, *extra)
        assert refused.exit_code == 2
        assert "levels" in refused.stderr and len(refused.stderr.splitlines()) == 1

"""The command `info`."""

import json

import numpy as np
from PIL import Image

from _helpers.command import assert_refused, run, succeeded
from eigengs_dr.eigenbasis.eigengs import SHIPPED


def test_info(fitted):
    folder, _ = fitted
    found = json.loads(succeeded(run("info", folder / "fit.npz", "--json")).stdout)
    expected = {"gaussians": 50, "width": 32, "height": 24, "channels": 3, "space": "ycbcr"}
    assert {key: found[key] for key in expected} == expected
    assert "gaussians   50" in run("info", folder / "fit.npz").stdout


def test_info_of_a_model(trained, tmp_path):
    folder, _ = trained
    preview = tmp_path / "sheet.png"
    found = json.loads(
        succeeded(run("info", folder / "m.npz", "--json", "--preview", preview)).stdout
    )
    expected = {
        "kind": "model",
        "gaussians": 60,
        "width": 32,
        "height": 32,
        "space": "ycbcr",
        "components": [6, 6, 6],
        "frequency_aware": True,
        "low_gaussians": 6,
        "high_gaussians": 54,
        "low_components": 3,
    }
    assert {key: found[key] for key in expected} == expected
    assert found["bytes"] == (folder / "m.npz").stat().st_size
    assert Image.open(preview).width < Image.open(folder / "m.png").width + 1 < 2001
    assert "low_components   3" in run("info", folder / "m.npz").stdout


def test_info_of_the_basis_that_ships(tmp_path):
    found = json.loads(succeeded(run("info", "natural", "--json")).stdout)
    assert found["file"] == str(SHIPPED["natural"])
    assert found["components"] == found["truncation"][-1]["components"] == [230, 60, 60]
    assert_refused(run("info", tmp_path / "natural"), tmp_path / "natural", "No such file")
    assert_refused(run("info", tmp_path), tmp_path, "Is a directory")


def test_info_preview_of_an_image(fitted, tmp_path):
    folder, _ = fitted
    succeeded(run("info", folder / "fit.npz", "--preview", tmp_path / "info.png"))
    succeeded(run("render", folder / "fit.npz", "-o", tmp_path / "render.png"))
    assert (tmp_path / "info.png").read_bytes() == (tmp_path / "render.png").read_bytes()
    gone = run("info", folder / "fit.npz", "--preview", tmp_path / "gone" / "x.png")
    assert_refused(gone, "gone")


def test_info_of_something_else(trained, tmp_path):
    folder, _ = trained
    np.savez(tmp_path / "x.npz", a=np.zeros(3))
    assert_refused(run("info", tmp_path / "x.npz"), "x.npz", "format")
    np.savez(tmp_path / "x.npz", format=np.array("something.else"))
    assert_refused(run("info", tmp_path / "x.npz"), "something.else", "eigengs_dr.model")
    assert_refused(run("info", folder / "m.png"), "m.png")
    assert_refused(run("render", folder / "m.npz", "-o", tmp_path / "y.png"), "eigengs_dr.model")

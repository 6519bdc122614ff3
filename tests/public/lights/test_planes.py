"""Planes of pixels for the viewers of the field: what they show, and what is refused."""

import json

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.command import assert_refused, run, said
from _helpers.lit_spheres import directions, photos


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """The file of a model of six planes, and the folder of its planes of pixels."""
    lights, folder = directions(35), tmp_path_factory.mktemp("planes")
    options = {"gaussians": 60, "planes": 6, "iterations": 20, "encoding": "srgb"}
    eg.Relightable.fit(photos(lights, 32), lights, **options).save(folder / "m.npz")
    told = said("render", folder / "m.npz", "--planes", folder / "planes")
    assert "6 planes of 32x32 pixels" in told
    return folder / "m.npz", folder / "planes"


def shown(folder, light):
    """Return what viewers show under a light, between directions of a grid on an octahedron.

    Rows and columns are x + y and y - x over the sum of lengths, as in toOcta of relight.
    """
    info = json.loads((folder / "info.json").read_text())
    [material], side = info["materials"], info["resolution"]
    files = sorted(folder.glob("plane_*.jpg"))
    planes = np.concatenate([np.asarray(Image.open(f), np.float32) / 255 for f in files], 2)
    mean, *rows = np.reshape(info["basis"], (-1, side, side, 3))
    rows = [(r - 127) / k for r, k in zip(rows, material["range"], strict=True)]
    grid, (x, y, z) = np.stack([*rows, mean / 255], 3), light
    turned = np.array([x + y, y - x]) / (abs(x) + abs(y) + max(z, 0))
    place = (turned + 1) / 2 * (side - 1)
    column, row = np.floor(place).astype(int).clip(0, side - 2)
    right, down = place - (column, row)
    weights = np.outer([1 - down, down], [1 - right, right])
    factors = np.tensordot(weights, grid[row : row + 2, column : column + 2], 2)
    images = (planes - material["bias"]) * material["scale"]
    return images @ factors[:, :-1].T + factors[:, -1]


def test_a_viewer_shows_what_the_model_shows(saved):
    model = eg.Relightable.load(saved[0])
    for light in directions(9, 0.4) @ np.diag([1, -1, 1]):
        assert eg.psnr(shown(saved[1], light), eg.picture_of(model.relight(light))) > 38


def test_files_are_those_that_viewers_ask_for(saved):
    folder = saved[1]
    info = json.loads((folder / "info.json").read_text())
    assert sorted(p.name for p in folder.iterdir()) == ["info.json", "plane_0.jpg", "plane_1.jpg"]
    assert (info["type"], info["colorspace"], info["nplanes"]) == ("bilinear", "mrgb", 6)
    assert len(info["basis"]) == 3 * 7 * info["resolution"] ** 2
    assert min(info["basis"]) >= 0 and max(info["basis"]) <= 255
    assert b"Adobe" in (folder / "plane_0.jpg").read_bytes()[:64]  # RGB, as relight writes it


def test_what_is_refused(saved, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    assert_refused(run("render", saved[0], "--planes", tmp_path), str(tmp_path))
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]
    planes = ("render", saved[0], "--planes", tmp_path / "planes")
    assert_refused(run(*planes, "--scale", 2), "no other options")
    assert_refused(run(*planes[:2]), "--output")

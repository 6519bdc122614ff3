"""Planes of pixels for the viewers of the field: what they show, and what is refused."""

import json

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.command import assert_refused, run, said
from _helpers.lit_spheres import directions, photos
from eigengs_dr.relight.planes import PixelPlanes
from eigengs_dr.relight.planes import directions as grid_directions

LIGHTS = directions(30)


@pytest.fixture(scope="module")
def model():
    options = {"gaussians": 80, "planes": 4, "iterations": 20, "progress": False}
    return eg.Relightable.fit(photos(LIGHTS), LIGHTS, encoding="srgb", **options)


@pytest.fixture
def folder(model, tmp_path):
    PixelPlanes.of(model).write(tmp_path / "planes", quality=100)
    return tmp_path / "planes"


def shown(folder, light):
    """Return what viewers show under a light: they interpolate between directions of the grid."""
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


def test_a_viewer_shows_what_the_model_shows(model, folder):
    for light in directions(9, 0.4) @ np.diag([1, -1, 1]):
        assert eg.psnr(shown(folder, light), eg.picture_of(model.relight(light))) > 38


def test_the_grid_is_the_octahedron_of_the_format():
    """Rows and columns from toOcta of relight: x + y and y - x over the sum of lengths."""
    found = grid_directions(8)
    turned = np.stack([found[:, 0] + found[:, 1], found[:, 1] - found[:, 0]], 1)
    place = (turned / abs(found).sum(1, keepdims=True) + 1) / 2 * 7
    y, x = np.mgrid[:8, :8]
    np.testing.assert_allclose(place, np.stack([x.ravel(), y.ravel()], 1), atol=1e-9)
    np.testing.assert_allclose(found[0], [0, -1, 0], atol=1e-9)


def test_a_direction_of_the_grid_is_exact(model):
    planes = PixelPlanes.of(model, 9)
    factors = model.table.at(np.array([[0.0, 0.0, 1.0]]))[0]
    np.testing.assert_allclose(planes.grid[4, 4, :, :4], factors[:, :4])
    np.testing.assert_allclose(planes.grid[4, 4, :, -1], factors[:, -1])


def test_files_are_those_that_viewers_ask_for(folder):
    info = json.loads((folder / "info.json").read_text())
    assert sorted(p.name for p in folder.iterdir()) == ["info.json", "plane_0.jpg", "plane_1.jpg"]
    assert (info["type"], info["colorspace"], info["nplanes"]) == ("bilinear", "mrgb", 6)
    assert len(info["basis"]) == 3 * 7 * info["resolution"] ** 2
    assert min(info["basis"]) >= 0 and max(info["basis"]) <= 255
    assert b"Adobe" in (folder / "plane_0.jpg").read_bytes()[:64]  # RGB, as relight writes it


def test_a_folder_that_holds_something_is_not_overwritten(model, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(OSError):
        PixelPlanes.of(model).write(tmp_path)
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_the_command_writes_planes(model, tmp_path):
    model.save(tmp_path / "model.npz")
    text = said("render", tmp_path / "model.npz", "--planes", tmp_path / "planes")
    assert "6 planes of 24x24 pixels" in text
    assert len(list((tmp_path / "planes").glob("plane_*.jpg"))) == 2


def test_planes_are_no_picture(model, tmp_path):
    model.save(tmp_path / "model.npz")
    command = ("render", tmp_path / "model.npz", "--planes", tmp_path / "planes")
    assert_refused(run(*command, "--scale", 2), "no other options")
    assert_refused(run(*command[:2]), "--output")

"""The scenes: pictures of them, and the scripts beside them."""

import importlib
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from _helpers.command import said
from _helpers.scene_sets import save_halves

mi = pytest.importorskip("mitsuba", reason="the scenes need mitsuba")

pytestmark = [pytest.mark.mitsuba, pytest.mark.exr]

ROOT = Path(__file__).parents[3]
SCENES = ROOT / "scenes"
SMALL = ["-D", "resolution=32", "--spp", "16", "--variant", "llvm_ad_rgb", "--quiet"]


@pytest.fixture(scope="module", autouse=True)
def scripts():
    """The folder of the scenes is where their scripts are imported from; the variant is kept."""
    before = mi.variant()
    sys.path.insert(0, str(SCENES))
    yield
    sys.path.remove(str(SCENES))
    if before:
        mi.set_variant(before)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return save_halves(tmp_path_factory.mktemp("sets"))


def rendered(name, folder, tmp_path, *options):
    """Linear radiance of a scene, shape (H, W, C), by the command."""
    path = tmp_path / f"{name}.exr"
    options = [*SMALL, "-D", f"folder={folder}", *options]
    assert said("scene", SCENES / f"{name}.xml", "-o", path, *options) == ""
    pixels = np.array(mi.Bitmap(str(path)))
    assert pixels.shape == (32, 32, 3)
    assert np.isfinite(pixels).all()
    return pixels


def redness(pixels):
    return float((pixels[..., 0] - pixels[..., 2]).mean())


def test_plane_repeats_its_texture_below_the_sky(folder, tmp_path):
    pixels = rendered("plane", folder, tmp_path, "-D", "prefilter=0.026")
    assert np.allclose(pixels[0], [0.4, 0.145, 0.0785], atol=0.01)
    near = pixels[16:, 16]
    change = np.diff(np.sign(near[:, 0] - near[:, 2]))
    assert np.count_nonzero(change) >= 2


@pytest.mark.parametrize(
    ("name", "above", "below"),
    [
        ("light", np.s_[6:11, 12:20], np.s_[15:19, 12:20]),
        ("cornell", np.s_[9:12, 12:20], np.s_[16:20, 15:18]),
    ],
)
def test_pictures_hang_upright(name, above, below, folder, tmp_path):
    pixels = rendered(name, folder, tmp_path)
    assert redness(pixels[above]) > 0.1
    assert redness(pixels[below]) < -0.1


def test_ball_shows_both_colours(folder, tmp_path):
    ball = rendered("ball", folder, tmp_path)[8:20, 10:22]
    assert (ball[..., 0] > 1.5 * ball[..., 2]).sum() > 10
    assert (ball[..., 2] > 1.5 * ball[..., 0]).sum() > 10


def test_assets_are_what_scenes_name(tmp_path):
    """And what is there is kept: nothing is fitted here."""
    assets = importlib.import_module("assets")
    named = {
        f"{name}.npz"
        for path in SCENES.glob("*.xml")
        for name in re.findall(r"\$folder/([\w-]+)\.npz", path.read_text())
    }
    for name in named:
        (tmp_path / name).write_text("kept")
    assets.main(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == named
    assert all(path.read_text() == "kept" for path in tmp_path.iterdir())
    color, roughness, normals = assets.tiles()
    for image in (color, roughness, normals):
        assert 0 <= np.min(image) < np.max(image) <= 1
    assert np.allclose(np.linalg.norm(2 * normals - 1, axis=2), 1) and roughness.ndim == 2


@pytest.mark.slow
def test_measurement_of_the_plane(folder, monkeypatch, tmp_path):
    plane = importlib.import_module("plane")
    monkeypatch.setattr(plane, "FOLDER", folder)
    strip = tmp_path / "strip.png"
    options = ["--resolution", "48", "--reference", "64", "--seeds", "2", "--strip", str(strip)]
    result = CliRunner().invoke(plane.main, options, catch_exceptions=False)
    assert result.exit_code == 0
    error = {
        line[:30].strip(): float(line[31:39]) for line in result.output.splitlines() if "+-" in line
    }
    assert len(error) == 5
    assert error["Gaussians, prefiltered"] < error["bitmap"] / 4
    assert strip.exists()

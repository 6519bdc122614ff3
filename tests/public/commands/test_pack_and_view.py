"""The commands `pack` and `view`: files and names in, few bytes or a page out."""

import re
import shutil
import time

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import assert_refused, run, said, smooth_pixels
from _helpers.materials import material


@pytest.fixture
def photo(fitted, tmp_path, monkeypatch):
    """A fitted image and its photo, in the current folder."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(fitted[0] / "photo.png", "photo.png")
    return shutil.copy(fitted[0] / "fit.npz", tmp_path / "photo.npz")


def page_of(path):
    return path.with_suffix(".html").read_text(encoding="utf-8")


def levels_of(page):
    return page.partition('"levels": [')[2].partition("]")[0]


def test_pack(photo, tmp_path):
    told = said("pack", photo, "-o", "x.egs", "--image", "photo.png", "--max-psnr-drop", 0.5)
    size = (tmp_path / "x.egs").stat().st_size
    assert f"{size:,} bytes, {8 * size / 1024:.3f} bits per pixel" in told
    told = said("info", "x.egs")
    for line in (rf"bytes +{size}", r"bpp +\d", r"color_step +\d"):
        assert re.search(f"(?m)^{line}", told)
    for suffix in ("npz", "egs"):
        said("render", photo if suffix == "npz" else "x.egs", "-o", f"{suffix}.png")
    assert eg.psnr(eg.load_image("npz.png"), eg.load_image("egs.png")) > 30
    assert_refused(run("pack", photo, "-o", "y.zip"), "y.zip", "must end in .egs")
    assert_refused(run("pack", photo, "-o", "y.egs", "--levels", 9), "photo.npz: levels is 9")
    of_maps = run("pack", photo, "-o", "y.egs", "--map", "a=photo.png")
    assert_refused(of_maps, "holds one image and no maps")


def test_writes_a_page_here_and_opens_it(photo, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "no program opens photo.html" in run("view", photo, "--open").stderr
    opener = tmp_path / "xdg-open"
    opener.write_text('#!/bin/sh\necho "$1" > opened\n')
    opener.chmod(0o755)
    told = said("view", photo, "--open")
    assert f"wrote photo.html ({(tmp_path / 'photo.html').stat().st_size:,} bytes)" in told
    while not (tmp_path / "opened").exists() or not (tmp_path / "opened").read_text():
        time.sleep(0.01)
    assert (tmp_path / "opened").read_text() == "photo.html\n"
    assert "64 Gaussians, 32 x 32 pixels" in page_of(photo) and levels_of(page_of(photo)) == ""


def test_shows_levels_and_a_photo(photo):
    assert said("view", photo, "--image", "photo.png", "--levels", 3, "--quiet") == ""
    assert levels_of(page_of(photo)) == "4, 16, 64"
    assert "data:image/jpeg;base64," in page_of(photo)
    said("view", photo, "--levels", "16,40,64")
    assert levels_of(page_of(photo)) == "16, 40, 64"
    said("pack", photo, "-o", "photo.egs", "--levels", 2, "--max-psnr-drop", 3)
    said("view", "photo.egs")
    assert levels_of(page_of(photo)) == "16, 64"


@pytest.mark.parametrize("command", ["view", "pack"])
def test_the_encoding_is_that_of_an_image(photo, command):
    page = photo.with_suffix(".html" if command == "view" else ".egs")
    assert_refused(run(command, photo, "-o", page, "--encoding", "linear"), "needs --image")


def test_shows_a_model(photo, trained):
    model = trained[0] / "m.npz"
    said("view", model, "--image", "photo.png", "-o", "model.html")
    assert "Random image" in page_of(photo.with_name("model.npz"))
    assert_refused(run("view", model, "--levels", 2), "leave out --levels and --map")


def test_shows_a_map_of_a_material(photo):
    """As its own set would be shown: normals have the length 1 after the sum."""
    bark = material(backend="llvm")
    bark.save("bark.npz")
    bark["normal"].save("normal.npz")
    said("view", "bark.npz", "--map", "normal")
    said("view", "normal.npz")
    pages = [page_of(photo.with_name(f"{name}.npz")) for name in ("bark", "normal")]
    assert pages[0].replace("bark", "normal") == pages[1]
    assert_refused(run("view", "bark.npz"), "bark.npz", "albedo, roughness, normal", "--map")
    assert_refused(run("view", "bark.npz", "--map", "gloss"), "no map is named 'gloss'")
    assert_refused(run("view", photo, "--map", "normal"), "photo.npz", "no maps")


def test_refuses_bad_input(photo, tmp_path):
    (tmp_path / "text.npz").write_text("text")
    (tmp_path / "text.png").write_text("text")
    eg.save_image("wide.png", smooth_pixels(32, 16))
    np.savez("other.npz", format="eigengs_dr.other", version=1)
    parts = [np.ones(((1 << 20) + 1, columns), np.float32) for columns in (2, 3, 1)]
    eg.Gaussians.from_arrays(*parts, size=(8, 8), space="data").save("many.npz")
    for arguments, words in (
        (["missing.npz"], ["missing.npz"]),
        (["text.npz"], ["text.npz"]),
        (["other.npz"], ["other.npz", "eigengs_dr.other"]),
        (["many.npz"], ["many.npz", "1,048,577 Gaussians are too many for a page"]),
        ([photo, "-o", "a.png"], ["a.png", "must end in .html"]),
        ([photo, "-o", "folder/a.html"], ["folder"]),
        ([photo, "--levels", 9], ["photo.npz", "levels is 9"]),
        ([photo, "--levels", "40,16,64"], ["levels is (40, 16, 64)"]),
        ([photo, "--light", "0,0,1"], ["photo.npz: is no model of lights; leave out --light"]),
        ([photo, "--image", "wide.png"], ["photo.npz", "32x16 pixels"]),
        ([photo, "--image", "text.png"], ["text.png"]),
    ):
        assert_refused(run("view", *arguments), *words)
    assert not list(tmp_path.glob("*.html"))

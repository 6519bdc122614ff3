"""The commands `view` and `pack`: files and names in, a page or few bytes out."""

import re
from pathlib import Path

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import assert_refused, run, said
from _helpers.families import small_model
from _helpers.materials import material
from _helpers.packed import few_groups, small_fit
from _helpers.sets import random_scene
from eigengs_dr.cli import pack as cli_pack
from eigengs_dr.codec import egs, packing
from eigengs_dr.viewer import view as page


@pytest.fixture
def photo(tmp_path, monkeypatch):
    """A fitted image and its photo, in the current folder."""
    monkeypatch.chdir(tmp_path)
    random_scene(0, 64, (32, 24)).on("llvm", space="rgb").save("photo.npz")
    eg.save_image("photo.png", np.full((24, 32, 3), 0.5))
    return tmp_path / "photo.npz"


def page_of(path):
    return path.with_suffix(".html").read_text(encoding="utf-8")


def levels_of(page):
    return page.partition('"levels": [')[2].partition("]")[0]


def test_writes_a_page_here(photo, monkeypatch):
    opened = []
    monkeypatch.setattr("click.launch", opened.append)
    told = said("view", photo, "--open")
    assert f"wrote photo.html ({Path('photo.html').stat().st_size:,} bytes)" in told
    assert opened == ["photo.html"]
    assert "64 Gaussians, 32 x 24 pixels" in page_of(photo) and levels_of(page_of(photo)) == ""


def test_no_program_that_opens_a_page_is_told(photo, monkeypatch):
    monkeypatch.setattr("click.launch", lambda page: 1)
    assert "no program opens photo.html" in run("view", photo, "--open").stderr


def test_shows_levels_and_a_photo(photo):
    assert said("view", photo, "--image", "photo.png", "--levels", 3, "--quiet") == ""
    assert levels_of(page_of(photo)) == "4, 16, 64"
    assert "data:image/png;base64," in page_of(photo)
    said("view", photo, "--levels", "16,40,64")
    assert levels_of(page_of(photo)) == "16, 40, 64"
    said("pack", photo, "-o", "photo.egs", "--levels", 2)
    said("view", "photo.egs")
    assert levels_of(page_of(photo)) == "16, 64"


@pytest.mark.parametrize("command", ["view", "pack"])
def test_the_encoding_is_that_of_an_image(photo, command):
    page = photo.with_suffix(".html" if command == "view" else ".egs")
    assert_refused(run(command, photo, "-o", page, "--encoding", "linear"), "needs --image")


def test_refuses_too_many_gaussians_before_it_decodes_them(photo, monkeypatch):
    said("pack", photo, "-o", "photo.egs", "--levels", 2)
    monkeypatch.setattr(page, "MAX_GAUSSIANS", 63)
    for name in ("photo.egs", "photo.npz"):
        assert_refused(run("view", name), name, "64 Gaussians are too many for a page")


def test_shows_a_model(photo):
    small_model("llvm").save("model.npz")
    said("view", "model.npz", "--image", "photo.png")
    assert "Random image" in page_of(photo.with_name("model.npz"))
    assert_refused(
        run("view", "model.npz", "--levels", 2), "model.npz", "leave out --levels and --map"
    )


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
    eg.save_image("square.png", np.zeros((32, 32, 3)))
    np.savez("other.npz", format="eigengs_dr.other", version=1)
    for arguments, words in (
        (["missing.npz"], ["missing.npz"]),
        (["text.npz"], ["text.npz"]),
        (["other.npz"], ["other.npz", "eigengs_dr.other"]),
        ([photo, "-o", "a.png"], ["a.png", "must end in .html"]),
        ([photo, "-o", "folder/a.html"], ["folder"]),
        ([photo, "--levels", 9], ["photo.npz", "levels is 9"]),
        ([photo, "--levels", "40,16,64"], ["levels 40, 16, 64"]),
        ([photo, "--image", "square.png"], ["photo.npz", "32x32 pixels"]),
        ([photo, "--image", "text.png"], ["text.png"]),
    ):
        assert_refused(run("view", *arguments), *words)
    assert not list(tmp_path.glob("*.html"))


@few_groups()
def test_pack(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    gaussians, image = small_fit()
    gaussians.save("x.npz")
    eg.save_image("x.png", image)
    told = said("pack", "x.npz", "-o", "x.egs", "--image", "x.png", "--max-psnr-drop", 0.2)
    size = (tmp_path / "x.egs").stat().st_size
    assert f"{size:,} bytes, {8 * size / 1024:.3f} bits per pixel" in told
    told = said("info", "x.egs")
    for line in (rf"bytes +{size}", r"bpp +\d", r"color_step +\d"):
        assert re.search(f"(?m)^{line}", told)
    for suffix in ("npz", "egs"):
        said("render", f"x.{suffix}", "-o", f"{suffix}.png")
    assert eg.psnr(eg.load_image("npz.png"), eg.load_image("egs.png")) > 30
    assert_refused(run("pack", "x.npz", "-o", "y.zip"), "y.zip", "must end in .egs")
    assert_refused(run("pack", "x.npz", "-o", "y.egs", "--levels", 9), "x.npz: levels is 9")


def test_the_command_knows_the_defaults():
    assert (egs.SUFFIX, packing.BUDGET) == (cli_pack.SUFFIX, cli_pack.BUDGET)

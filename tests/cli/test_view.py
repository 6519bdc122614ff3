"""The command `view`: files and names in, one page out, one line for an error."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import assert_refused, run, said
from _helpers.families import small_model
from _helpers.materials import material
from _helpers.sets import random_scene
from eigengs_dr.codec import egs
from eigengs_dr.viewer import view as page


@pytest.fixture
def photo(tmp_path, monkeypatch):
    """A fitted image and its photo, in the current folder."""
    monkeypatch.chdir(tmp_path)
    random_scene(0, 64, (32, 24)).on("llvm", space="rgb").save("photo.npz")
    eg.save_image("photo.png", np.full((24, 32, 3), 0.5))
    return tmp_path / "photo.npz"


def levels_of(page):
    text = page.read_text(encoding="utf-8")
    return text.partition('"levels": [')[2].partition("]")[0]


def test_writes_a_page_here(photo, tmp_path):
    assert "wrote photo.html" in said("view", photo)
    page = tmp_path / "photo.html"
    assert "64 Gaussians, 32 x 24 pixels" in page.read_text(encoding="utf-8")
    assert levels_of(page) == ""


def test_shows_levels_and_a_photo(photo, tmp_path):
    assert (
        said("view", photo, "--image", "photo.png", "--levels", 3, "-o", "a.html", "--quiet") == ""
    )
    assert levels_of(tmp_path / "a.html") == "4, 16, 64"
    assert "data:image/png;base64," in (tmp_path / "a.html").read_text(encoding="utf-8")


def test_sections_of_a_packed_file_are_levels(photo, tmp_path):
    said("pack", photo, "-o", "photo.egs", "--levels", 2)
    said("view", "photo.egs")
    assert levels_of(tmp_path / "photo.html") == "16, 64"


def test_refuses_too_many_gaussians_before_it_decodes_them(photo, tmp_path, monkeypatch):
    said("pack", photo, "-o", "photo.egs", "--levels", 2)
    monkeypatch.setattr(page, "MAX_GAUSSIANS", 63)
    monkeypatch.setattr(egs, "decode_body", None)
    for name in ("photo.egs", "photo.npz"):
        assert_refused(run("view", name), name, "64 Gaussians are too many for a page")


def test_shows_a_model(photo, tmp_path):
    small_model("llvm").save("model.npz")
    said("view", "model.npz", "--image", "photo.png")
    assert "Random image" in (tmp_path / "model.html").read_text(encoding="utf-8")
    assert_refused(run("view", "model.npz", "--levels", 2), "model.npz", "leave --levels out")


def test_shows_a_map_of_a_material(photo, tmp_path):
    """As its own set would be shown: normals have the length 1 after the sum."""
    bark = material(backend="llvm")
    bark.save("bark.npz")
    bark["normal"].save("normal.npz")
    for name, options in (("bark", ("--map", "normal")), ("normal", ())):
        said("view", f"{name}.npz", *options, "-o", f"{name}.html")
    pages = [
        (tmp_path / f"{name}.html").read_text(encoding="utf-8").replace("bark", "normal")
        for name in ("bark", "normal")
    ]
    assert pages[0] == pages[1]
    assert_refused(run("view", "bark.npz"), "bark.npz", "albedo, roughness, normal", "--map")
    assert_refused(run("view", "bark.npz", "--map", "gloss"), "'gloss' is not in it")
    assert_refused(run("view", photo, "--map", "normal"), "photo.npz", "no maps")


def test_opens_the_page(photo, monkeypatch):
    opened = []
    monkeypatch.setattr("click.launch", opened.append)
    said("view", photo, "--open")
    assert opened == ["photo.html"]


def test_refuses_bad_input(photo, tmp_path):
    assert_refused(run("view", "missing.npz"), "missing.npz")
    (tmp_path / "text.npz").write_text("text")
    assert_refused(run("view", "text.npz"), "text.npz")
    assert_refused(run("view", photo, "-o", "a.png"), "a.png", "must end in .html")
    assert_refused(run("view", photo, "-o", "folder/a.html"), "folder")
    assert_refused(run("view", photo, "--levels", 9), "photo.npz", "levels is 9")
    eg.save_image("square.png", np.zeros((32, 32, 3)))
    assert_refused(run("view", photo, "--image", "square.png"), "photo.npz", "32x32 pixels")
    (tmp_path / "text.png").write_text("text")
    assert_refused(run("view", photo, "--image", "text.png"), "text.png")
    np.savez("other.npz", format="eigengs_dr.other", version=1)
    assert_refused(run("view", "other.npz"), "other.npz", "eigengs_dr.other")
    assert not list(tmp_path.glob("*.html"))

"""The command `info`: what it says of sets, models and folders, and of files that it refuses."""

import json
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.command import assert_refused, run, said, smooth_pixels
from _helpers.lit_models import LitFormula
from _helpers.materials import material


def facts_of(*arguments):
    return json.loads(said("info", *arguments, "--json"))


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """A fit of a file."""
    photo = tmp_path_factory.mktemp("fitted") / "photo.png"
    eg.save_image(photo, smooth_pixels(32, 32))
    return eg.fit(photo, 64, iterations=5)


@pytest.fixture
def set_file(result, tmp_path):
    """A file of the fit, which tests may change."""
    result.save(tmp_path / "a.npz")
    return tmp_path / "a.npz"


def test_info_of_a_fit(result, set_file):
    facts = facts_of(set_file)
    expected = {"kind": "image", "gaussians": 64, "width": 32, "height": 32, "channels": 3}
    expected |= {"space": "ycbcr", "iterations": 5, "source": "photo.png"}
    assert {key: facts[key] for key in expected} == expected
    assert facts["psnr_rgb"] == pytest.approx(result.psnr_rgb, abs=0.01)
    assert {"mean", "factor", "color", "background"} <= set(facts["ledger"])
    assert 0 < sum(facts["ledger"].values()) < facts["bytes"]
    assert "texture_bytes" not in facts
    text = said("info", set_file)
    assert "gaussians   64" in text and "photo.png" in text and "bpp" in text


@pytest.mark.slow
@pytest.mark.mitsuba
def test_info_of_textures(set_file):
    """At least the arrays of the file; with a prefilter more."""
    pytest.importorskip("mitsuba", reason="textures need mitsuba")
    facts = facts_of(set_file, "--texture")
    assert facts["prefilter_bytes"] > facts["texture_bytes"] > 32 * facts["gaussians"]
    header, row = said("info", set_file.parent, "--texture").splitlines()
    assert header.split()[6:] == ["texture_bytes", "prefilter_bytes", "small_bytes"]
    assert row.split()[6] == f"{facts['texture_bytes']:,}"


def test_a_set_that_was_edited_claims_no_figures(set_file, tmp_path):
    eg.Gaussians.load(set_file)[:20].save(tmp_path / "b.npz")
    facts = facts_of(tmp_path / "b.npz")
    assert "psnr_rgb" not in facts and facts["gaussians"] == 20


def test_lossless_psnr_and_strange_names_are_shown(result, tmp_path):
    replace(result, source="a\x1b[31m.png", psnr_rgb=math.inf).save(tmp_path / "c.npz")
    facts = facts_of(tmp_path / "c.npz")
    assert facts["source"] == r"a\x1b[31m.png" and facts["psnr_rgb"] == "inf"


def test_info_of_a_model(trained, tmp_path):
    file, preview = trained[0] / "m.npz", tmp_path / "sheet.png"
    facts = facts_of(file, "--preview", preview)
    expected = {"kind": "model", "gaussians": 60, "width": 32, "height": 32, "space": "ycbcr"}
    expected |= {"components": [6, 6, 6], "frequency_aware": True, "bytes": file.stat().st_size}
    expected |= {"low_gaussians": 6, "high_gaussians": 54, "low_components": 3}
    assert {key: facts[key] for key in expected} == expected
    assert Image.open(preview).width < Image.open(trained[0] / "m.png").width + 1 < 2001
    assert "low_components   3" in said("info", file)


def test_info_of_the_basis_that_ships(tmp_path):
    facts = facts_of("natural")
    assert facts["components"] == facts["truncation"][-1]["components"] == [230, 60, 60]
    assert_refused(run("info", tmp_path / "natural"), "natural: is neither a file nor")


def test_info_of_something_else(trained, tmp_path):
    np.savez(tmp_path / "x.npz", a=np.zeros(3))
    assert_refused(run("info", tmp_path / "x.npz"), "x.npz", "format")
    np.savez(tmp_path / "x.npz", format=np.array("something.else"))
    assert_refused(run("info", tmp_path / "x.npz"), "something.else", "eigengs_dr.model")
    assert_refused(run("info", trained[0] / "m.png"), "m.png")


# --- Folders ---


@pytest.fixture(scope="module")
def fits(result, tmp_path_factory):
    """A folder with a fit, a packed set, a model of lights and a material."""
    folder = tmp_path_factory.mktemp("place") / "fits"
    folder.mkdir()
    result.save(folder / "a.npz")
    eg.pack(result.gaussians, folder / "b.egs", smooth_pixels(32, 32), 3)
    LitFormula().model().save(folder / "c.npz")
    material().save(folder / "d.npz")
    (folder / "notes.txt").write_text("no set")
    return folder


def test_a_folder_of_sets_is_a_table(fits):
    header, *rows = said("info", fits).splitlines()
    assert header.split() == ["file", "kind", "size", "gaussians", "bytes", "psnr"]
    facts = facts_of(fits)
    left_out = LitFormula().model().psnr_held_out
    psnr = [f"{value:.2f}" for value in (facts[0]["psnr_rgb"], facts[1]["psnr"], left_out)]
    kinds = ["image", "image", "lights", "material"]
    for row, known, kind, value in zip(rows, facts, kinds, [*psnr, "-"], strict=True):
        size = f"{known['width']}x{known['height']}"
        numbers = [f"{known[key]:,}" for key in ("gaussians", "bytes")]
        assert row.split() == [known["file"].split("/")[-1], kind, size, *numbers, value]
    assert {len(row) for row in rows} == {len(header)}
    assert said("info", fits / "a.npz").startswith("file ")  # a file has its block


def test_all_sets_of_a_folder_are_drawn_and_packed(set_file, tmp_path):
    """One that cannot be is an error, with exit code 2; files of other kinds are left alone."""
    fits, report = tmp_path / "fits", tmp_path / "r.json"
    fits.mkdir()
    for name in ("a.npz", "b.npz"):
        shutil.copy(set_file, fits / name)
    (fits / "notes.txt").write_text("no set")
    assert said("info", fits, "--preview", tmp_path / "seen").count(" image ") == 2
    said("render", fits, "-o", tmp_path / "drawn", "--size", 16)
    for folder in ("seen", "drawn"):
        assert sorted(path.name for path in (tmp_path / folder).iterdir()) == ["a.png", "b.png"]
    (fits / "b.npz").write_bytes(b"no set")
    outputs = ["-o", tmp_path / "packed", "--report", report]
    packed = run("pack", fits, *outputs, "--max-psnr-drop", 3)
    assert packed.exit_code == 2 and "error: " in packed.stderr and "b.npz: not a" in packed.stderr
    [figures] = json.loads(report.read_text())["sets"]
    assert figures["bytes"] == (tmp_path / "packed" / "a.egs").stat().st_size
    shown = run("info", fits)
    assert shown.exit_code == 2 and "b.npz" in shown.stderr
    assert [row.split()[0] for row in shown.stdout.splitlines()[1:]] == ["a.npz"]
    image = run("pack", fits, "-o", tmp_path / "x", "--image", fits / "a.npz")
    assert_refused(image, "--image and --map belong to one set")
    assert_refused(run("render", fits, "-o", tmp_path / "x.png"), "need a folder")


@pytest.mark.parametrize("command", [["view"], ["render", "--planes", "out"]])
def test_a_folder_where_a_file_belongs_is_named_with_its_files(fits, command, monkeypatch):
    monkeypatch.chdir(fits.parent)
    result = run(command[0], "fits", *command[1:])
    assert_refused(result, "fits: is a folder; give one of its files (.npz, .egs): a.npz, b.egs")
    assert "notes.txt" not in result.stderr


@pytest.mark.parametrize(
    "command",
    [["view"], ["info"], ["render", "-o", "x"], ["render", "--planes", "x"], ["pack", "-o", "x"]],
    ids=" ".join,
)
def test_a_folder_without_sets_is_refused_by_what_it_lacks(photo, command):
    result = run(command[0], photo.parent, *command[1:])
    assert_refused(result, f"{photo.parent}: holds no files ending in .npz")


# --- Files that others wrote ---


@pytest.mark.parametrize(
    "change",
    [
        {"figures": np.zeros(2)},
        {"figures": np.zeros(3, np.float32)},
        {"source": np.array("x" * 65)},
    ],
)
def test_hostile_figures_are_refused_in_one_line(change, set_file):
    np.savez(set_file, **dict(np.load(set_file)) | change)
    assert_refused(run("info", set_file), set_file)
    assert len(eg.Gaussians.load(set_file)) == 64  # the set itself is whole


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mean": np.full((64, 2), np.nan, np.float32)}, "not finite"),
        ({"space": np.array("a\x1b[31m")}, r"space is 'a\x1b[31m'"),
        ({"color": np.full((64, 3), 3e38, np.float32)}, "of a channel add up to 1.92e+40"),
    ],
)
def test_what_cannot_be_loaded_is_not_described(change, words, set_file):
    np.savez(set_file, **dict(np.load(set_file)) | change)
    assert_refused(run("info", set_file), set_file, words)
    with pytest.raises(ValueError, match=r"a\.npz: "):
        eg.Gaussians.load(set_file)


def test_text_from_files_cannot_command_the_terminal(set_file, tmp_path):
    """A name of a member of the archive, and the name of the file itself."""
    file = tmp_path / "b\x1b[31m.npz"
    np.savez(file, **dict(np.load(set_file)) | {"x\x1b[2J": np.zeros(3)})
    text = said("info", file)
    assert r"b\x1b[31m.npz" in text and r"x\x1b[2J" in text and "\x1b" not in text

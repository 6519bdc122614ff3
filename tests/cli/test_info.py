"""The commands `info` and `doctor`."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.command import assert_refused, run, said
from _helpers.packed import few_groups
from eigengs_dr.eigenbasis.eigengs import SHIPPED


def facts_of(*arguments):
    return json.loads(said("info", *arguments, "--json"))


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """A fit of a file."""
    photo = tmp_path_factory.mktemp("fitted") / "photo.png"
    eg.save_image(photo, eg.sample("coffee")[:32, :32])
    return eg.fit(photo, 40, iterations=10)


@pytest.fixture
def set_file(result, tmp_path):
    """A fit, and a file of it, which tests may change."""
    result.save(tmp_path / "a.npz")
    return result, tmp_path / "a.npz"


def test_info_of_a_fit(set_file):
    result, file = set_file
    facts = facts_of(file)
    expected = {"kind": "image", "gaussians": 40, "width": 32, "height": 32, "channels": 3}
    expected |= {"space": "ycbcr", "iterations": 10, "source": "photo.png"}
    assert {key: facts[key] for key in expected} == expected
    assert facts["psnr_rgb"] == pytest.approx(result.psnr_rgb, abs=0.01)
    assert {"mean", "factor", "color", "background"} <= set(facts["ledger"])
    assert 0 < sum(facts["ledger"].values()) < facts["bytes"]
    text = said("info", file)
    assert "gaussians   40" in text and "photo.png" in text and "bpp" in text


@few_groups()
def test_sets_in_a_folder(set_file, trained, tmp_path):
    """All are shown, rendered and packed; one that cannot be is an error, with exit code 2."""
    fits = tmp_path / "fits"
    fits.mkdir()
    empty = run("info", fits)
    assert_refused(empty, "fits: holds no files ending in .npz or .egs")
    for name in ("a", "b"):
        (fits / f"{name}.npz").write_bytes(set_file[1].read_bytes())
    (fits / "notes.txt").write_text("")
    assert [facts["gaussians"] for facts in facts_of(fits)] == [40, 40]
    assert said("info", fits, "--preview", tmp_path / "seen").count(" image ") == 2
    said("render", fits, "-o", tmp_path / "drawn", "--size", 16)
    assert sorted(path.name for path in (tmp_path / "drawn").iterdir()) == ["a.png", "b.png"]
    assert len(list((tmp_path / "seen").iterdir())) == 2
    (fits / "b.npz").write_bytes(b"no set")
    report = tmp_path / "r.json"
    packed = run("pack", fits, "-o", tmp_path / "packed", "--report", report)
    assert packed.exit_code == 2 and "error: " in packed.stderr and "b.npz: not a" in packed.stderr
    [figures] = json.loads(report.read_text())["sets"]
    assert figures["bytes"] == (tmp_path / "packed" / "a.egs").stat().st_size
    shown = run("info", fits)
    assert shown.exit_code == 2 and shown.stdout.count(" image ") == 1
    image = run("pack", fits, "-o", tmp_path / "x", "--image", set_file[1])
    assert_refused(image, "--image and --map belong to one set")
    assert_refused(run("render", fits, "-o", tmp_path / "x.png"), "need a folder")


def test_info_of_textures(set_file, trained, tmp_path):
    """At least the arrays of the file; with a prefilter more."""
    pytest.importorskip("mitsuba", reason="textures need mitsuba")
    for file in (set_file[1], trained[0] / "m.npz"):
        assert "texture_bytes" not in facts_of(file)
        facts = facts_of(file, "--texture")
        assert facts["texture_bytes"] > 32 * facts["gaussians"]
        assert facts["prefilter_bytes"] > facts["texture_bytes"]


def test_a_set_that_was_edited_claims_no_figures(set_file, tmp_path):
    eg.Gaussians.load(set_file[1])[:20].save(tmp_path / "b.npz")
    facts = facts_of(tmp_path / "b.npz")
    assert "psnr_rgb" not in facts and facts["gaussians"] == 20


@pytest.mark.parametrize(
    "change",
    [
        {"figures": np.zeros(2)},
        {"figures": np.zeros(3, np.float32)},
        {"figures": np.array([1.0, 2.0, -3.0])},
        {"figures": np.array([1.0, 2.0, np.inf])},
        {"source": np.array("x" * 65)},
        {"source": np.zeros(3)},
    ],
)
def test_hostile_figures_are_refused_in_one_line(change, set_file):
    file = set_file[1]
    np.savez(file, **dict(np.load(file)) | change)
    assert_refused(run("info", file), file)
    assert len(eg.Gaussians.load(file)) == 40  # the set itself is whole


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mean": np.full((40, 2), np.nan, np.float32)}, "not finite"),
        ({"size": np.array([0, 32])}, "size is (0, 32)"),
        ({"size": np.array([], np.int64)}, "size is ()"),
        ({"space": np.array("a\x1b[31m")}, r"space is 'a\x1b[31m'"),
        (
            {"color": np.full((40, 3), 3e38, np.float32)},
            "color and background of a channel add up to 1.2e+40",
        ),
    ],
)
def test_what_cannot_be_loaded_is_not_described(change, words, set_file):
    file = set_file[1]
    np.savez(file, **dict(np.load(file)) | change)
    assert_refused(run("info", file), file, words)
    with pytest.raises(ValueError, match=r"a\.npz: "):
        eg.Gaussians.load(file)


def test_text_from_files_cannot_command_the_terminal(set_file, tmp_path):
    """A name of a member of the archive, and the name of the file itself."""
    file = tmp_path / "b\x1b[31m.npz"
    np.savez(file, **dict(np.load(set_file[1])) | {"x\x1b[2J": np.zeros(3)})
    text = said("info", file)
    assert r"b\x1b[31m.npz" in text and r"x\x1b[2J" in text and "\x1b" not in text


def test_lossless_psnr_and_strange_names_are_shown(set_file, tmp_path):
    replace(set_file[0], source="a\x1b[31m.png", psnr_rgb=math.inf).save(tmp_path / "c.npz")
    facts = facts_of(tmp_path / "c.npz")
    assert facts["source"] == r"a\x1b[31m.png" and facts["psnr_rgb"] == "inf"


def test_info_of_a_model(trained, tmp_path):
    folder, _ = trained
    preview = tmp_path / "sheet.png"
    found = facts_of(folder / "m.npz", "--preview", preview)
    expected = {"kind": "model", "gaussians": 60, "width": 32, "height": 32, "space": "ycbcr"}
    expected |= {"components": [6, 6, 6], "frequency_aware": True}
    expected |= {"low_gaussians": 6, "high_gaussians": 54, "low_components": 3}
    assert {key: found[key] for key in expected} == expected
    assert found["bytes"] == (folder / "m.npz").stat().st_size
    assert Image.open(preview).width < Image.open(folder / "m.png").width + 1 < 2001
    assert "low_components   3" in said("info", folder / "m.npz")


def test_info_of_the_basis_that_ships(tmp_path):
    found = facts_of("natural")
    assert found["file"] == str(SHIPPED["natural"])
    assert found["components"] == found["truncation"][-1]["components"] == [230, 60, 60]
    assert_refused(run("info", tmp_path / "natural"), tmp_path / "natural", "No such file")
    assert_refused(run("info", tmp_path), tmp_path, "holds no files ending in .npz or .egs")


def test_info_of_something_else(trained, tmp_path):
    folder, _ = trained
    np.savez(tmp_path / "x.npz", a=np.zeros(3))
    assert_refused(run("info", tmp_path / "x.npz"), "x.npz", "format")
    np.savez(tmp_path / "x.npz", format=np.array("something.else"))
    assert_refused(run("info", tmp_path / "x.npz"), "something.else", "eigengs_dr.model")
    assert_refused(run("info", folder / "m.png"), "m.png")

"""Materials on the command line: fit --map, render --map, info, pack, and mistakes."""

import json

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import assert_refused, run, said, succeeded
from _helpers.materials import images


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The images of three maps."""
    path = tmp_path_factory.mktemp("maps")
    for name, image in images(32).items():
        eg.save_image(path / f"{name}.png", image)
    eg.save_image(path / "other.png", np.zeros((9, 8, 3)))
    return path


def maps(folder, *names):
    """Options that name maps."""
    names = names or ("albedo", "roughness", "normal")
    return [word for name in names for word in ("--map", f"{name}={folder / name}.png")]


@pytest.fixture(scope="module")
def fitted(folder):
    """The file of a fit, with a preview and a report."""
    files = ("-o", folder / "m.npz", "--preview", folder / "p.png", "--report", folder / "r.json")
    told = said("fit", *maps(folder), *files, "--gaussians", 8, "--iterations", 5)
    assert "albedo in linear (channels: 3)" in told
    return folder / "m.npz"


def test_fit(fitted, folder):
    report = json.loads((folder / "r.json").read_text())
    assert [m["name"] for m in report["maps"]] == ["albedo", "roughness", "normal"]
    assert report["gaussians"] == 8 and report["trace"][0]["maps"]["normal"]["psnr_rgb"] > 10
    assert report["input"]["albedo"] == str(folder / "albedo.png")
    material = eg.Gaussians.load(fitted)
    for m in report["maps"]:
        psnr = eg.psnr(images(32)[m["name"]], eg.picture_of(material)[m["name"]])
        assert psnr == pytest.approx(m["psnr_rgb"], abs=0.3)  # the files have 8 bits
    assert eg.load_image(folder / "p.png").shape == (3 * 512, 3 * 512, 3)


def test_render(fitted, tmp_path):
    target = tmp_path / "r.png"
    assert said("render", fitted, "-o", target, "--map", "roughness", "--quiet") == ""
    expected = eg.picture_of(eg.Gaussians.load(fitted))["roughness"]
    found = eg.load_image(target, keep_grey=True)
    np.testing.assert_allclose(found, np.clip(expected, 0, 1), atol=1 / 255)


def test_info(fitted, tmp_path):
    facts = json.loads(said("info", fitted, "--json", "--preview", tmp_path / "p.png"))
    assert (facts["kind"], facts["gaussians"], facts["channels"]) == ("material", 8, 7)
    spaces = {"albedo": "linear", "roughness": "data", "normal": "normal"}
    assert {m["name"]: m["space"] for m in facts["maps"]} == spaces
    assert eg.load_image(tmp_path / "p.png").shape[0] == 32
    text = said("info", fitted)
    assert "roughness" in text and "weight" in text


@pytest.mark.slow
def test_pack(fitted, folder, tmp_path):
    target = tmp_path / "m.egs"
    assert "roughness" in said("pack", fitted, "-o", target, *maps(folder), "--max-psnr-drop", 3)
    facts = json.loads(said("info", target, "--json"))
    assert (facts["kind"], facts["gaussians"], len(facts["maps"])) == ("material", 8, 3)
    succeeded(run("render", target, "-o", tmp_path / "n.png", "--map", "normal"))


def test_what_is_no_material_is_never_replaced(fitted, folder, tmp_path):
    set_file = tmp_path / "set.npz"
    eg.Gaussians.load(fitted)["albedo"].save(set_file)
    before = set_file.read_bytes()
    reason = "set.npz: exists and is not a material; choose another name with -o"
    assert_refused(run("fit", *maps(folder), "-o", set_file, "--overwrite"), reason)
    assert set_file.read_bytes() == before


FIT = ["fit", "--map", "albedo={0}/albedo.png", "-o", "x.npz"]
MISTAKES = {
    "size": ([*FIT, "--map", "b={0}/other.png"], "differ in size: albedo 32x32, b 8x9"),
    "no file": ([*FIT, "--map", "ao={0}/ao.png"], "no such file"),
    "space": ([*FIT, "--map", "ao:hsv={0}/other.png"], "space 'hsv' is not in"),
    "twice": ([*FIT, "--map", "albedo={0}/other.png"], "--map albedo is given twice"),
    "an image": ([*FIT, "{0}/other.png"], "images and --map exclude each other: name all images"),
    "colour": ([*FIT, "--space", "rgb"], "--space and --map exclude each other"),
    "channels": (
        [*FIT, *(w for k in range(5) for w in ("--map", f"n{k}:normal={{0}}/normal.png"))],
        "the maps have 18 channels, the limit is 16",
    ),
    "no output": (FIT[:3], "--map needs -o"),
    "nothing": (["fit"], "no image is given"),
    "no map": (["render", "{1}", "-o", "x.png"], "holds the maps albedo, roughness, normal"),
    "image": (["pack", "{1}", "-o", "x.egs", "--image", "{0}/albedo.png"], "--map"),
    "levels": (["pack", "{1}", "-o", "x.egs", "--levels", 2], "a material has no levels"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes(fitted, folder, tmp_path, case, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments, words = MISTAKES[case]
    assert_refused(run(*(str(word).format(folder, fitted) for word in arguments)), words)
    assert not list(tmp_path.iterdir())

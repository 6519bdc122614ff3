"""The command `train`: families of images, photos under lights, and mistakes."""

import json
import shutil

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import SMALL, assert_refused, run, said, succeeded
from _helpers.lit_spheres import directions, photos
from _helpers.photos import random_fields

# --- A family of images ---


def test_train_says_what_it_did(trained):
    folder, result = trained
    words = ("11 images", "6+6+6 components", "60 Gaussians", "psnr_pca", "psnr_init", "m.png")
    assert all(word in result.stdout for word in words)
    assert result.stdout.count("\n") == 3 and result.stderr == ""
    assert not (folder / "m.npz.checkpoint").exists()


def test_report(trained):
    folder, _ = trained
    report = json.loads((folder / "m.json").read_text())
    expected = {"input": str(folder / "photos"), "output": str(folder / "m.npz"), "seed": 0}
    expected |= {"size": [32, 32], "components": [6, 6, 6], "most_components": 6, "energy": None}
    expected |= {"gaussians": 60, "frequency_aware": True, "preset": "default", "space": "ycbcr"}
    assert {key: report[key] for key in expected} == expected
    assert report["command"].startswith("eigengs-dr train ") and not report["resumed"]
    assert report["versions"]["drjit"]
    for key in ("seconds", "pca_seconds", "shape_seconds", "weight_seconds"):
        assert report[key] > 0
    assert report["psnr_solved"] > report["psnr_init"] > 15
    assert report["psnr_init"] == pytest.approx(report["psnr_pca"], abs=1.5)


def test_few_images_and_subfolders_are_noted_once(tmp_path):
    """Although the folder is listed twice; and no image can be held out of so few."""
    folder = random_fields(tmp_path / "photos", 5)
    random_fields(folder / "more", 1)
    outputs = ["-o", tmp_path / "m.npz", "--report", tmp_path / "m.json"]
    result = succeeded(run("train", folder, *outputs, *SMALL))
    assert result.stderr.count("images in its subfolders are left out") == 1
    assert "note: 5 images give at most 4 components" in result.stderr
    assert "no image was held out" in result.stdout
    report = json.loads((tmp_path / "m.json").read_text())
    assert [report[key] for key in ("psnr_pca", "psnr_init", "psnr_solved")] == [None] * 3


def test_target_psnr(tmp_path):
    images = random_fields(tmp_path / "photos", 30)
    report, model = tmp_path / "r.json", tmp_path / "m.npz"
    text = said("train", images, "-o", model, "--report", report, *SMALL, "--target-psnr", 21)
    assert " s; not split\n" in text
    figures = json.loads(report.read_text())
    assert figures["target_psnr"] == 21
    assert figures["psnr_held_out"][-1] >= 21 > figures["psnr_held_out"][-2]
    rows = json.loads(said("info", model, "--json"))["truncation"]
    assert rows[0]["components"] == [0, 0, 0] and rows[0]["variance"] == 0
    assert rows[-1]["components"] == figures["components"]
    assert rows[-1]["psnr_held_out"] == pytest.approx(figures["psnr_held_out"][-1], abs=1e-3)
    table = said("info", model).splitlines()[-len(rows) - 1 :]
    assert table[0].split() == ["components", "variance", "training", "held", "out"]
    assert [int(line.split()[0]) for line in table[1:]] == [sum(r["components"]) for r in rows]
    assert f"{figures['psnr_held_out'][-1]:.2f} dB" in table[-1]
    assert len({len(line) for line in table}) == 1


MISTAKES = [
    (["--gaussians", 1025, "--size", "32x32"], "gaussians is 1025"),
    (["--components", "3,4"], "3,4: expected a number above 0, or three such as 230,60,60"),
    (["--size", "32"], "such as 1024x768"),
    (["-o", "m.png"], ".npz"),
    (["--preview", "p.txt"], ".png"),
]


@pytest.mark.parametrize(("options", "word"), MISTAKES)
def test_mistakes(trained, existing, options, word, monkeypatch):
    monkeypatch.chdir(existing.parent)
    before = sorted(existing.parent.iterdir())
    assert_refused(run("train", trained[0] / "photos", "-o", existing, *options), word)
    assert sorted(existing.parent.iterdir()) == before


def test_mistaken_folders(trained, existing, tmp_path):
    images = trained[0] / "photos"
    assert_refused(run("train", tmp_path / "gone", "-o", existing), "gone")
    assert_refused(run("train", images / "000.png", "-o", existing), "000.png")
    over = run("train", images, "-o", existing, "--preview", images / "000.png")
    assert_refused(over, "000.png", "is read")
    bad = tmp_path / "bad"
    bad.mkdir()
    assert_refused(run("train", bad, "-o", existing), "holds no images")
    (bad / "x.png").write_bytes(b"no picture")
    assert_refused(run("train", bad, "-o", existing, *SMALL), "none of 1", "x.png")
    assert not (tmp_path / "existing.npz.checkpoint").exists()


# --- Photos of one object under known lights ---

LIGHTS = directions(16)
FEW = ["--gaussians", 60, "--iterations", 2]


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """A folder of photos and the list of their lights."""
    folder = tmp_path_factory.mktemp("photos") / "coin"
    folder.mkdir()
    lines = [str(len(LIGHTS))]
    for k, (image, light) in enumerate(zip(photos(LIGHTS, 32), LIGHTS, strict=True)):
        eg.save_image(folder / f"{k}.png", image)
        lines.append(f"{k}.png " + " ".join(map(str, light)))
    (folder / "dirs.lp").write_text("\n".join(lines))
    return folder


@pytest.fixture
def coin(taken, tmp_path, monkeypatch):
    """A copy of the folder in the current one."""
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(taken, tmp_path / "coin")


@pytest.fixture(scope="module")
def lit(taken):
    """The file of a model of the photos."""
    file = taken.parent / "m.npz"
    outputs = ["-o", file, "--report", taken.parent / "r.json", "--lights", taken / "dirs.lp"]
    said("train", taken, *outputs, "--gaussians", 60, "--iterations", 20, "--components", "3")
    return file


def test_a_model_of_lights_and_its_figures(lit):
    model = eg.Relightable.load(lit)
    assert (len(model.planes), model.planes.channels, len(model.lights)) == (60, 3, 16)
    np.testing.assert_allclose(model.lights, LIGHTS, atol=1e-5)
    report = json.loads((lit.parent / "r.json").read_text())
    assert report["psnr_held_out"] == pytest.approx(model.psnr_held_out)
    assert report["planes"] == 3 and report["lights"] == 16
    facts = json.loads(said("info", lit, "--json"))
    assert facts["kind"] == "lights" and facts["planes"] == 3 and facts["lights"] == 16


def test_render_takes_a_light(lit, tmp_path):
    packed = lit.with_suffix(".egs")
    said("pack", lit, "-o", packed, "--max-psnr-drop", 3)
    for file in (lit, packed):
        output = tmp_path / "x.png"
        said("render", file, "-o", output, "--light", "0.3,0.2,0.9", "--size", "48")
        expected = eg.picture_of(eg.Relightable.load(file).relight((0.3, 0.2, 0.9)), 48)
        assert np.abs(eg.load_image(output) - np.clip(expected, 0, 1)).max() < 0.01
    said("render", lit, "--planes", tmp_path / "planes")
    assert (tmp_path / "planes" / "info.json").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "give --light"),
        (["--light", "0,1"], "expected x,y,z"),
        (["--light", "0,0,1", "--map", "a"], "--light and --map exclude each other"),
        (["--planes", "x"], "--planes takes no other options"),
    ],
)
def test_mistakes_of_a_rendering(lit, tmp_path, options, message):
    assert_refused(run("render", lit, "-o", tmp_path / "x.png", *options), message)


@pytest.mark.parametrize("given", [[], ["--lights", "coin/dirs.lp", "--encoding", "linear"]])
def test_a_list_in_the_folder_counts_as_given(coin, given):
    """Codes that count as linear light are brighter codes."""
    result = succeeded(run("train", "coin", "-o", "m.npz", *FEW, *given))
    model = eg.Relightable.load("m.npz")
    assert np.allclose(model.lights, LIGHTS, atol=1e-5)
    brighter = eg.picture_of(model.relight(LIGHTS[3])) - photos(LIGHTS, 32)[3]
    assert (brighter.mean() > 0.1) == bool(given)
    note = "eigengs-dr: note: coin/dirs.lp names the lights of the photos: training a model of "
    note += "lights; give 'coin/*.png' to train a family\n"
    assert result.stderr == ("" if given else note)


@pytest.mark.parametrize(
    "options",
    [
        ["--size", "16x16"],
        ["--components", "4", "name the list with --lights"],
        ["--space", "rgb"],
        ["--preset", "eigengs", "--frequency-aware", "yes"],
    ],
)
def test_what_is_for_families_is_refused_by_name(coin, options):
    result = run("train", "coin", "-o", "m.npz", *FEW, *options[: len(options) // 2 * 2])
    assert_refused(result, "coin/dirs.lp names the lights", *options[::2], "'coin/*.png'")


@pytest.mark.parametrize(
    ("lights", "options", "message"),
    [
        ("coin/dirs.lp", ["--energy", "0.9"], "--energy and --lights exclude each other"),
        ("coin/dirs.lp", ["--components", "3,2,1"], "--components is one number with --lights"),
        ("coin/0.png", [], "no text"),
    ],
)
def test_mistakes_of_lights(coin, lights, options, message):
    result = run("train", "coin", "-o", "m.npz", "--lights", lights, *options)
    assert_refused(result, message)


def test_a_budget_is_for_lights(coin):
    command = ["train", "coin/*.png", "-o", "m.npz", "--max-psnr-drop", 40]
    assert_refused(run(*command), "--max-psnr-drop needs --lights")
    succeeded(run(*command, "--lights", "coin/dirs.lp", "--iterations", 2))
    assert len(eg.Relightable.load("m.npz").planes) == 1


def test_of_several_lists_none_is_taken(coin):
    shutil.copy(coin / "dirs.lp", coin / "other.lp")
    result = run("train", "coin", "-o", "m.npz", *FEW)
    assert_refused(result, "coin: holds 2 lists of lights (dirs.lp, other.lp)", "--lights")
    succeeded(run("train", "coin", "-o", "m.npz", *FEW, "--lights", "coin/other.lp"))


def test_a_pattern_trains_a_family_as_its_folder_does(coin):
    small = ["--size", "32x32", "--components", 3, "--gaussians", 60]
    assert succeeded(run("train", "coin/*.png", "-o", "a.npz", *small)).stderr == ""
    succeeded(run("train", "coin/*.png", "-o", "m.npz", *FEW, "--lights", "coin/dirs.lp"))
    assert np.allclose(eg.Relightable.load("m.npz").lights, LIGHTS, atol=1e-5)
    with pytest.warns(UserWarning, match=r"dirs\.lp: names the lights of photos; Relightable"):
        eg.Eigenbasis.from_images(coin, (32, 32), 3, progress=False)
    (coin / "dirs.lp").unlink()
    succeeded(run("train", "coin", "-o", "b.npz", *small))
    pattern, folder = (eg.EigenGS.load(name).gaussians.to_arrays() for name in ("a.npz", "b.npz"))
    assert all(np.array_equal(pattern[name], folder[name]) for name in pattern)
    succeeded(run("train", "coin/[0-3].png", "-o", ".", *small))
    assert eg.EigenGS.load("coin.npz").components == (3, 3, 3)
    assert_refused(run("train", "coin/*.jpg", "-o", "c.npz", *small), "no file matches")

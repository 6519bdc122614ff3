"""Folders on the command line: of photos with a list of lights, of sets, and wrong ones."""

import json
import shutil

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import SMALL, assert_refused, run, said, succeeded
from _helpers.lit_models import LitFormula
from _helpers.lit_spheres import directions, photos
from _helpers.packed import few_groups
from _helpers.photos import random_fields

LIGHTS = directions(8)
FEW = ["--gaussians", 16, "--iterations", 2]


@pytest.fixture
def coin(tmp_path, monkeypatch):
    """A folder of photos and the list of their lights, in the current folder."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "coin"
    folder.mkdir()
    lines = ["8"]
    for k, (image, light) in enumerate(zip(photos(LIGHTS, 16), LIGHTS, strict=True)):
        eg.save_image(folder / f"{k}.png", image)
        lines.append(f"{k}.png " + " ".join(map(str, light)))
    (folder / "dirs.lp").write_text("\n".join(lines))
    return folder


@pytest.mark.parametrize("given", [[], ["--lights", "coin/dirs.lp"]], ids=["found", "given"])
def test_a_list_in_the_folder_counts_as_given(coin, given):
    result = succeeded(run("train", "coin", "-o", "m.npz", *FEW, *given))
    model = eg.Relightable.load("m.npz")
    assert np.allclose(model.lights, LIGHTS, atol=1e-5)
    note = "eigengs-dr: note: coin/dirs.lp names the lights of the photos: training a model of "
    note += "lights; give 'coin/*.png' to train a family\n"
    assert result.stderr == ("" if given else note)


def test_hidden_lists_do_not_count_and_capitals_do(coin):
    shutil.copy(coin / "dirs.lp", coin / "._dirs.lp")
    (coin / "dirs.lp").rename(coin / "DIRS.LP")
    note = succeeded(run("train", "coin", "-o", "m.npz", *FEW)).stderr
    assert "coin/DIRS.LP names the lights" in note and note.count("\n") == 1


@pytest.mark.parametrize(
    "options",
    [
        ["--size", "16x16"],
        ["--components", "4"],
        ["--energy", "0.9"],
        ["--target-psnr", "30"],
        ["--space", "rgb"],
        ["--preset", "eigengs", "--frequency-aware", "yes"],
    ],
)
def test_what_is_for_families_is_refused_by_name(coin, options):
    result = run("train", "coin", "-o", "m.npz", *FEW, *options)
    assert_refused(result, "coin/dirs.lp names the lights", *options[::2], "'coin/*.png'")
    assert not (coin.parent / "m.npz").exists()


def test_of_several_lists_none_is_taken(coin):
    shutil.copy(coin / "dirs.lp", coin / "other.lp")
    result = run("train", "coin", "-o", "m.npz", *FEW)
    assert_refused(result, "coin: holds 2 lists of lights (dirs.lp, other.lp)", "--lights")
    succeeded(run("train", "coin", "-o", "m.npz", *FEW, "--lights", "coin/other.lp"))


def test_a_pattern_trains_a_family_as_its_folder_does(coin):
    small = ["--size", "16x16", "--components", 3, "--gaussians", 30]
    assert succeeded(run("train", "coin/*.png", "-o", "a.npz", *small)).stderr == ""
    (coin / "dirs.lp").unlink()
    succeeded(run("train", "coin", "-o", "b.npz", *small))
    pattern, folder = (eg.EigenGS.load(name).gaussians.to_arrays() for name in ("a.npz", "b.npz"))
    assert all(np.array_equal(pattern[name], folder[name]) for name in pattern)
    succeeded(run("train", "coin/[0-3].png", "-o", ".", *small))
    assert eg.EigenGS.load("coin.npz").components == (3, 3, 3)
    assert_refused(run("train", "coin/*.jpg", "-o", "c.npz", *small), "no file matches")
    assert_refused(run("train", "coin/0.png", "-o", "c.npz", *small), "0.png", "folder")


def test_lights_take_a_pattern_too(coin):
    succeeded(run("train", "coin/*.png", "-o", "m.npz", *FEW, "--lights", "coin/dirs.lp"))
    assert np.allclose(eg.Relightable.load("m.npz").lights, LIGHTS, atol=1e-5)


def test_an_eigenbasis_of_photos_under_lights_warns(coin):
    with pytest.warns(UserWarning, match=r"dirs\.lp: names the lights of photos; Relightable"):
        eg.Eigenbasis.from_images(coin, (16, 16), 3, progress=False)


def test_a_family_beside_no_list_says_nothing(tmp_path):
    faces = random_fields(tmp_path / "faces", 11)
    assert succeeded(run("train", faces, "-o", tmp_path / "m.npz", *SMALL)).stderr == ""


@pytest.fixture(scope="module")
def fits(tmp_path_factory):
    """A folder with a set and its fit, a packed set, a model of lights and a material."""
    folder = tmp_path_factory.mktemp("place") / "fits"
    folder.mkdir()
    photo = np.random.default_rng(0).uniform(size=(16, 24, 3)).astype(np.float32)
    fit = eg.fit(photo, gaussians=30, iterations=3, progress=False)
    fit.save(folder / "a.npz")
    with few_groups():
        eg.pack(fit.gaussians, folder / "b.egs", photo)
    LitFormula().model().save(folder / "c.npz")
    maps = {"albedo": photo, "roughness": photo[..., :1]}
    eg.fit(maps, gaussians=20, iterations=2, progress=False).save(folder / "d.npz")
    (folder / "notes.txt").write_text("no set")
    return folder


def test_a_folder_of_sets_is_a_table(fits):
    header, *rows = said("info", fits).splitlines()
    assert header.split() == ["file", "kind", "size", "gaussians", "bytes", "psnr"]
    facts = json.loads(said("info", fits, "--json"))
    psnr = [f"{facts[0]['psnr_rgb']:.2f}", f"{facts[1]['psnr']:.2f}", "30.00", "-"]
    kinds = ["image", "image", "lights", "material"]
    for row, known, kind, value in zip(rows, facts, kinds, psnr, strict=True):
        size = f"{known['width']}x{known['height']}"
        numbers = [f"{known[key]:,}" for key in ("gaussians", "bytes")]
        assert row.split() == [known["file"].split("/")[-1], kind, size, *numbers, value]
    assert {len(row) for row in rows} == {len(header)}
    assert said("info", fits / "a.npz").startswith("file ")  # a file has its block


def test_memory_of_textures_is_in_the_table(fits):
    pytest.importorskip("mitsuba", reason="textures need mitsuba")
    header, *rows = said("info", fits, "--texture").splitlines()
    assert header.split()[6:] == ["texture_bytes", "prefilter_bytes", "small_bytes"]
    facts = json.loads(said("info", fits, "--texture", "--json"))
    assert [row.split()[6] for row in rows] == [f"{f['texture_bytes']:,}" for f in facts]


def test_a_damaged_file_leaves_the_rows_of_the_others(fits, tmp_path):
    folder = shutil.copytree(fits, tmp_path / "some")
    (folder / "b.egs").write_bytes(b"EGS")
    result = run("info", folder)
    assert result.exit_code == 2 and "b.egs" in result.stderr
    assert [row.split()[0] for row in result.stdout.splitlines()[1:]] == ["a.npz", "c.npz", "d.npz"]


@pytest.mark.parametrize("command", [["view"], ["render", "--planes", "out"]])
def test_a_folder_where_a_file_belongs_is_named_with_its_files(fits, command, monkeypatch):
    monkeypatch.chdir(fits.parent)
    result = run(command[0], "fits", *command[1:])
    files = "a.npz, b.egs, c.npz, ..." if command == ["view"] else "a.npz"
    assert_refused(result, "fits: is a folder", "give one of its files (.npz, .egs)", files)
    assert "notes.txt" not in result.stderr and "Is a directory" not in result.stderr


@pytest.mark.parametrize(
    "command",
    [["view"], ["info"], ["render", "-o", "x"], ["render", "--planes", "x"], ["pack", "-o", "x"]],
    ids=" ".join,
)
def test_a_folder_without_sets_is_refused_by_what_it_lacks(coin, command):
    assert_refused(run(command[0], "coin", *command[1:]), "coin: holds no files ending in .npz")

"""Materials on the command line: fit --map, render --map, info, pack, and mistakes."""

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import eigengs_dr as eg
from _helpers.materials import images
from eigengs_dr.cli.main import main
from eigengs_dr.fitting.fit import FitInterrupted


def run(*arguments):
    """Call the program with its arguments."""
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The images of three maps."""
    path = tmp_path_factory.mktemp("maps")
    for name, image in images(24).items():
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
    file = folder / "m.npz"
    files = ("-o", file, "--preview", folder / "p.png", "--report", folder / "r.json")
    settings = ("--gaussians", 8, "--iterations", 5)
    result = run("fit", *maps(folder), *files, *settings)
    assert result.exit_code == 0, result.output
    assert "albedo in linear (channels: 3)" in result.output
    return file


def test_fit(fitted, folder):
    report = json.loads((folder / "r.json").read_text())
    assert [m["name"] for m in report["maps"]] == ["albedo", "roughness", "normal"]
    assert report["gaussians"] == 8 and report["trace"][0]["maps"]["normal"]["psnr_rgb"] > 10
    material = eg.Gaussians.load(fitted)
    for m in report["maps"]:
        psnr = eg.psnr(images(24)[m["name"]], eg.picture_of(material)[m["name"]])
        assert psnr == pytest.approx(m["psnr_rgb"], abs=0.3)  # the files have 8 bits
    assert eg.load_image(folder / "p.png").shape == (3 * 528, 3 * 528, 3)


def test_render(fitted, tmp_path):
    result = run("render", fitted, "-o", tmp_path / "r.png", "--map", "roughness", "--quiet")
    assert result.exit_code == 0, result.output
    found = eg.load_image(tmp_path / "r.png", keep_grey=True)
    expected = eg.picture_of(eg.Gaussians.load(fitted))["roughness"]
    np.testing.assert_allclose(found, np.clip(expected, 0, 1), atol=1 / 255)


def test_info(fitted, tmp_path):
    facts = json.loads(run("info", fitted, "--json", "--preview", tmp_path / "p.png").output)
    assert (facts["kind"], facts["gaussians"], facts["channels"]) == ("material", 8, 7)
    assert [(m["name"], m["space"]) for m in facts["maps"]] == [
        ("albedo", "linear"),
        ("roughness", "data"),
        ("normal", "normal"),
    ]
    assert eg.load_image(tmp_path / "p.png").shape[0] == 24
    text = run("info", fitted).output
    assert "roughness" in text and "weight" in text


def test_pack(fitted, folder, tmp_path):
    target = tmp_path / "m.egs"
    result = run("pack", fitted, "-o", target, *maps(folder), "--max-psnr-drop", 3)
    assert result.exit_code == 0, result.output
    assert "roughness" in result.output
    facts = json.loads(run("info", target, "--json").output)
    assert (facts["kind"], facts["gaussians"], len(facts["maps"])) == ("material", 8, 3)
    result = run("render", target, "-o", tmp_path / "n.png", "--map", "normal", "--quiet")
    assert result.exit_code == 0, result.output


def test_an_interrupted_fit_is_kept(folder, tmp_path, monkeypatch):
    result = replace(eg.fit(images(24), 5, iterations=0), stopped="interrupted")

    def pressed(*arguments, **settings):
        raise FitInterrupted(result)

    monkeypatch.setattr("eigengs_dr.fit", pressed)
    result_of_run = run("fit", *maps(folder), "-o", tmp_path / "m.npz", "--gaussians", 9)
    assert result_of_run.exit_code == 130
    assert "interrupted; the best fit so far" in result_of_run.output
    assert len(eg.Gaussians.load(tmp_path / "m.npz")) == 5


def test_a_result_is_kept(fitted, folder, tmp_path):
    """A material, as a set, and what is no material is never replaced."""
    file, set_file = tmp_path / "m.npz", tmp_path / "set.npz"
    file.write_bytes(fitted.read_bytes())
    eg.Gaussians.load(fitted)["albedo"].save(set_file)
    command = ["fit", *maps(folder), "--gaussians", 9, "--iterations", 1, "-o"]
    again = run(*command, file)
    assert again.exit_code == 0 and file.read_bytes() == fitted.read_bytes()
    assert again.stderr == f"eigengs-dr: {file}: exists and is kept; --overwrite fits it again\n"
    before = set_file.read_bytes()
    other = run(*command, set_file, "--overwrite")
    assert other.exit_code == 2 and set_file.read_bytes() == before
    assert "set.npz: exists and is no material; choose another name with -o" in other.stderr
    assert run(*command, file, "--overwrite").exit_code == 0
    assert len(eg.Gaussians.load(file)) == 9


def test_out_of_reach(folder, tmp_path):
    settings = ("--target-psnr", 90, "--max-gaussians", 20, "--iterations", 5)
    result = run("fit", *maps(folder, "albedo"), "-o", tmp_path / "m.npz", *settings)
    assert (
        result.exit_code == 1
        and "90 dB psnr_rgb are out of reach: 20 Gaussians have" in result.output
    )
    assert (tmp_path / "m.npz").exists()


MISTAKES = {
    "size": (["--map", "other={0}/other.png"], "differ in size: albedo 24x24, other 8x9"),
    "name": (["--map", "1={0}/other.png"], "expected a name and a file"),
    "no file": (["--map", "ao={0}/ao.png"], "no such file"),
    "space": (["--map", "ao:hsv={0}/other.png"], "space 'hsv' is not in"),
    "twice": (["--map", "albedo={0}/other.png"], "--map albedo is given twice"),
    "an image": (["{0}/other.png"], "an image without a name"),
    "colour": (["--space", "rgb"], "--space and --map exclude each other"),
    "basis": (["--basis", "natural"], "--basis and --map exclude each other"),
    "suffix": (["-o", "x.egs"], "the name must end in .npz"),
    "channels": (
        [w for k in range(5) for w in ("--map", f"n{k}:normal={{0}}/normal.png")],
        "the maps have 18 channels, at most 16 share shapes",
    ),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes(folder, tmp_path, case, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given, words = MISTAKES[case]
    arguments = [word.format(folder) for word in given]
    output = [] if "-o" in arguments else ["-o", "m.npz"]
    result = run("fit", *maps(folder, "albedo"), *output, *arguments)
    assert result.exit_code == 2, result.output
    assert words in result.output and len(result.output.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_more_mistakes(fitted, folder, tmp_path):
    for arguments, words in (
        (["fit", *maps(folder)], "--map needs -o"),
        (["fit"], "no image is given"),
        (["render", fitted, "-o", tmp_path / "x.png"], "holds the maps albedo, roughness, normal"),
        (["render", fitted, "-o", tmp_path / "x.png", "--map", "ao"], "map 'ao' is not in it; it"),
        (["pack", fitted, "-o", tmp_path / "x.egs", "--image", folder / "albedo.png"], "--map"),
        (["pack", fitted, "-o", tmp_path / "x.egs", *maps(folder, "albedo")], "give one of each"),
        (["pack", fitted, "-o", tmp_path / "x.egs", "--levels", 2], "a material has no levels"),
    ):
        result = run(*arguments)
        assert result.exit_code == 2, result.output
        assert words in result.output and len(result.output.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())

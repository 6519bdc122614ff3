"""The commands for photos of one object under known lights."""

import json

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import assert_refused, run, said
from _helpers.lit_spheres import directions, photos
from _helpers.packed import few_groups
from eigengs_dr.storage.atomic import lock_output

LIGHTS = directions(16)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder of photos and the list of their lights, with a model of them."""
    folder = tmp_path_factory.mktemp("photos")
    lines = ["16"]
    for k, (image, light) in enumerate(zip(photos(LIGHTS), LIGHTS, strict=True)):
        eg.save_image(folder / f"{k}.png", image)
        lines.append(f"{k}.png " + " ".join(map(str, light)))
    (folder / "dirs.lp").write_text("\n".join(lines))
    said(
        "train", folder, "-o", folder / "model.npz", "--lights", folder / "dirs.lp",
        "--gaussians", "60", "--iterations", "20", "--components", "5",
        "--report", folder / "report.json",
    )  # fmt: skip
    return folder


def test_train_with_lights_writes_a_model_and_its_figures(folder):
    model = eg.Relightable.load(folder / "model.npz")
    assert (len(model.planes), model.planes.channels, len(model.lights)) == (60, 5, 16)
    report = json.loads((folder / "report.json").read_text())
    assert report["psnr_held_out"] == pytest.approx(model.psnr_held_out)
    assert report["planes"] == 5 and report["lights"] == 16


@few_groups()
def test_render_takes_a_light(folder, tmp_path):
    for name in ("model.npz", "model.egs"):
        if name.endswith("egs"):
            said("pack", folder / "model.npz", "-o", folder / name)
        output = tmp_path / f"{name}.png"
        said("render", folder / name, "-o", output, "--light", "0.3,0.2,0.9", "--size", "48")
        image = eg.load_image(output)
        model = eg.Relightable.load(folder / name)
        expected = eg.picture_of(model.relight((0.3, 0.2, 0.9)), 48)
        assert np.abs(image - np.clip(expected, 0, 1)).max() < 0.01


def test_info_describes_a_model_of_lights(folder):
    facts = json.loads(said("info", folder / "model.npz", "--json"))
    assert facts["kind"] == "lights" and facts["planes"] == 5 and facts["lights"] == 16


@pytest.mark.mitsuba
def test_info_knows_the_memory_of_its_texture(folder):
    facts = json.loads(said("info", folder / "model.npz", "--json", "--texture"))
    assert facts["prefilter_bytes"] > facts["texture_bytes"] > 0


@pytest.mark.parametrize(
    ("command", "source", "options", "message"),
    [
        ("render", "model.npz", [], "give --light"),
        ("render", "model.npz", ["--light", "0,1"], "expected x,y,z"),
        ("render", "model.npz", ["--light", "0,0,-1"], "below the horizon"),
        ("train", "", ["--lights", "dirs.lp", "--energy", "0.9"], "--energy"),
        ("train", "", ["--lights", "0.png"], "no text"),
    ],
)
def test_wrong_commands_are_refused_in_one_line(
    folder, tmp_path, command, source, options, message
):
    paths = [folder / word if (folder / word).is_file() else word for word in options]
    output = tmp_path / ("x.png" if command == "render" else "x.npz")
    assert_refused(run(command, folder / source, "-o", output, *paths), message)


def test_photos_at_a_url_are_refused(folder, tmp_path):
    lights = ["--lights", folder / "dirs.lp", "-o", tmp_path / "x.npz"]
    assert_refused(run("train", "https://host.example/photos", *lights), "a folder of this machine")


def test_a_second_training_into_one_model_is_refused(folder, tmp_path):
    output = tmp_path / "x.npz"
    with lock_output(output):
        ended = run("train", folder, "--lights", folder / "dirs.lp", "-o", output)
    assert_refused(ended, "wait for its end")

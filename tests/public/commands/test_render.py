"""The command `render`: sizes, spaces, and files of floats and of 16 bits."""

import json

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.command import assert_refused, previewed, run, said, smooth_pixels, succeeded
from _helpers.light import to_coded

FEW = ["--gaussians", 200, "--iterations", 20, "--quiet"]


@pytest.mark.parametrize(
    ("options", "size"),
    [
        ([], (32, 32)),
        (["--scale", "2"], (64, 64)),
        (["--size", "10x7"], (10, 7)),
        (["--size", "16"], (16, 16)),
        (["--size", "30", "--region", "4,4,20,10"], (30, 15)),
    ],
)
def test_sizes(fitted, tmp_path, options, size):
    target = tmp_path / "y.png"
    told = said("render", fitted[0] / "fit.npz", "-o", target, *options)
    assert Image.open(target).size == size
    assert str(target) in told and "{}x{}".format(*size) in told
    assert said("render", fitted[0] / "fit.npz", "-o", target, "--quiet") == ""


@pytest.mark.parametrize(
    "options",
    [
        ["--scale", "2", "--size", "10x10"],
        *(["--scale", word] for word in ("0", "-1", "nan", "inf", "1e9")),
        *(["--size", word] for word in ("10x", "0", "0x10", "10x-1", "99999999999x10")),
        ["--size", "25600x25600"],
        *(["--region", word] for word in ("1,2,3", "a,b,c,d", "0,0,0,5", "-1,0,5,5", "9,0,24,9")),
    ],
)
def test_bad_sizes(fitted, tmp_path, options):
    result = run("render", fitted[0] / "fit.npz", "-o", tmp_path / "y.png", *options)
    assert_refused(result, "exclude each other" if len(options) > 2 else options[1])
    assert not (tmp_path / "y.png").exists()


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_region_is_the_crop_of_the_whole(fitted, tmp_path, suffix):
    part, whole = tmp_path / f"y.{suffix}", tmp_path / "whole.png"
    scaled = ["render", fitted[0] / "fit.npz", "--scale", 2, "-o"]
    said(*scaled, part, "--region", "3,5,14,10")
    said(*scaled, whole)
    found = np.asarray(Image.open(part)).astype(int)
    expected = np.asarray(Image.open(whole).crop((6, 10, 34, 30))).astype(int)
    assert np.abs(found - expected).max() <= 1


@pytest.mark.parametrize(
    ("space", "channels", "modes"),
    [
        ("linear", 3, ("RGB", "RGB")),
        ("linear", 1, ("L", "RGB")),
        ("data", 1, ("L", "L")),
    ],
)
def test_spaces_of_textures(tmp_path, space, channels, modes):
    """What `render` and `info` draw is the fit of the preview, as the report has it."""
    pixels = smooth_pixels(32, 32, channels)
    Image.fromarray(pixels if channels == 3 else pixels[..., 0]).save(tmp_path / "a.png")
    outputs = ["-o", tmp_path / "a.npz", "--preview", tmp_path / "both.png"]
    settings = ["--gaussians", 100, "--iterations", 20, "--report", tmp_path / "a.json"]
    told = said("fit", tmp_path / "a.png", "--space", space, *outputs, *settings)
    report = json.loads((tmp_path / "a.json").read_text())
    assert report["space"] == space
    assert ("psnr_data" if space == "data" else "psnr_ycbcr") in told
    assert report["psnr_rgb"] > 25 and 0.9 < report["ms_ssim"] <= 1
    info = json.loads(said("info", tmp_path / "a.npz", "--json"))
    assert (info["space"], info["channels"]) == (space, 1 if modes[1] == "L" else 3)
    succeeded(run("info", tmp_path / "a.npz", "--preview", tmp_path / "info.png"))
    succeeded(run("render", tmp_path / "a.npz", "-o", tmp_path / "y.png"))
    drawn, shown = (Image.open(tmp_path / n) for n in ("y.png", "info.png"))
    assert {image.mode for image in (drawn, shown)} == {modes[1]}
    _, fit, _ = previewed(tmp_path / "both.png")
    np.testing.assert_array_equal(fit, np.asarray(drawn.convert("RGB")))
    np.testing.assert_array_equal(fit, np.asarray(shown.convert("RGB")))
    error = (fit.astype(float) - pixels) / 255
    assert -10 * np.log10(np.mean(error**2)) == pytest.approx(report["psnr_rgb"], abs=0.02)


# --- Files of floats and of 16 bits ---


@pytest.fixture(scope="module")
def sky(tmp_path_factory):
    """A folder with an EXR file of light up to 50, and its fit."""
    folder = tmp_path_factory.mktemp("sky")
    light = smooth_pixels(32, 32).astype(np.float32) / 100
    light[5:9, 7:11] = 50
    eg.save_image(folder / "sky.exr", light)
    command = ["fit", folder / "sky.exr", "-o", folder / "sky.npz", "--space", "log", *FEW]
    succeeded(run(*command, "--report", folder / "r.json", "--preview", folder / "p.png"))
    return folder, light


def test_fit_of_light(sky):
    folder, _ = sky
    figures = json.loads((folder / "r.json").read_text())
    assert figures["psnr_ycbcr"] > 25 and figures["encoding"] is None
    assert eg.load_image(folder / "p.png").shape[1] > 32
    assert eg.Gaussians.load(folder / "sky.npz").space == "log"


@pytest.mark.parametrize(("name", "bits"), [("y.exr", 32), ("y.tif", 32), ("h.exr", 16)])
def test_light_is_written(sky, tmp_path, name, bits):
    folder, light = sky
    succeeded(run("render", folder / "sky.npz", "-o", tmp_path / name, "--bits", bits))
    found = eg.load_image(tmp_path / name)
    assert found.shape == light.shape
    assert found.max() == pytest.approx(50, rel=0.2)
    assert np.median(found) == pytest.approx(np.median(light), rel=0.05)


def test_codes_become_light_in_exr(fitted, tmp_path):
    for name in ("y.png", "y.exr"):
        said("render", fitted[0] / "fit.npz", "-o", tmp_path / name)
    shown, light = (eg.load_image(tmp_path / name) for name in ("y.png", "y.exr"))
    np.testing.assert_allclose(shown, to_coded(light).clip(0, 1), atol=0.003)


def test_an_encoding_can_be_said(photo, tmp_path):
    """Codes that count as linear light are that of the rendering."""
    command = ["fit", photo, "-o", tmp_path / "a.npz", *FEW, "--space", "linear"]
    succeeded(run(*command, "--encoding", "linear"))
    succeeded(run("render", tmp_path / "a.npz", "-o", tmp_path / "y.exr"))
    means = [float(eg.load_image(path).mean()) for path in (photo, tmp_path / "y.exr")]
    assert means[0] == pytest.approx(means[1], rel=0.02)


def test_data_of_16_bits(tmp_path):
    y, x = np.mgrid[:32, :32]
    heights = (30_000 + 200 * x + 90 * y).astype(np.uint16)
    eg.save_image(tmp_path / "a.png", heights, bits=16)
    succeeded(run("fit", tmp_path / "a.png", "-o", tmp_path / "a.npz", "--space", "data", *FEW))
    succeeded(run("render", tmp_path / "a.npz", "-o", tmp_path / "y.png", "--bits", 16))
    found = np.rint(eg.load_image(tmp_path / "y.png", keep_grey=True) * 65535)[..., 0]
    assert np.abs(found - heights).mean() < 60  # a step of 8 bits is 257

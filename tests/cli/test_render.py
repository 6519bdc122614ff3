"""The command `render`."""

import json

import numpy as np
import pytest
from PIL import Image

from _helpers.command import assert_refused, previewed, run, smooth_pixels, succeeded


@pytest.mark.parametrize(
    ("options", "size"),
    [([], (32, 24)), (["--scale", "2"], (64, 48)), (["--size", "10x7"], (10, 7))],
)
def test_render_sizes(fitted, tmp_path, options, size):
    folder, _ = fitted
    succeeded(run("render", folder / "fit.npz", "-o", tmp_path / "y.png", *options))
    assert Image.open(tmp_path / "y.png").size == size


def test_render_is_what_was_fitted(fitted, tmp_path):
    folder, _ = fitted
    succeeded(run("render", folder / "fit.npz", "-o", tmp_path / "y.png"))
    _, fit, _ = previewed(folder / "both.png")
    assert np.abs(fit.astype(int) - np.asarray(Image.open(tmp_path / "y.png"))).max() <= 1


@pytest.mark.parametrize(
    ("color", "channels", "modes"),
    [
        ("linear", 3, ("RGB", "RGB")),
        ("linear", 1, ("L", "RGB")),
        ("data", 3, ("RGB", "RGB")),
        ("data", 1, ("L", "L")),
    ],
)
def test_spaces_of_textures(tmp_path, color, channels, modes):
    """What `render` and `info` draw is the fit of the preview, as the report has it."""
    pixels = smooth_pixels(32, 32, channels)
    Image.fromarray(pixels if channels == 3 else pixels[..., 0]).save(tmp_path / "a.png")
    assert Image.open(tmp_path / "a.png").mode == modes[0]
    outputs = ["-o", tmp_path / "a.npz", "--preview", tmp_path / "both.png"]
    settings = ["--gaussians", 100, "--iterations", 20, "--report", tmp_path / "a.json"]
    result = succeeded(run("fit", tmp_path / "a.png", "--space", color, *outputs, *settings))
    report = json.loads((tmp_path / "a.json").read_text())
    assert report["space"] == color
    assert ("psnr_data" if color == "data" else "psnr_ycbcr") in result.stdout
    assert report["psnr_rgb"] > 25 and 0.9 < report["ms_ssim"] <= 1
    info = json.loads(run("info", tmp_path / "a.npz", "--json").stdout)
    assert (info["space"], info["channels"]) == (color, 1 if modes[1] == "L" else 3)
    succeeded(run("info", tmp_path / "a.npz", "--preview", tmp_path / "info.png"))
    succeeded(run("render", tmp_path / "a.npz", "-o", tmp_path / "y.png"))
    drawn, shown = (Image.open(tmp_path / n) for n in ("y.png", "info.png"))
    assert {image.mode for image in (drawn, shown)} == {modes[1]}
    _, fit, _ = previewed(tmp_path / "both.png")
    np.testing.assert_array_equal(fit, np.asarray(drawn.convert("RGB")))
    np.testing.assert_array_equal(fit, np.asarray(shown.convert("RGB")))
    error = (fit.astype(float) - pixels) / 255
    assert -10 * np.log10(np.mean(error**2)) == pytest.approx(report["psnr_rgb"], abs=0.02)


@pytest.mark.parametrize("keep", [0, 10, 0.5, 0.95])
def test_truncated_model(fitted, existing, tmp_path, keep):
    folder, _ = fitted
    content = (folder / "fit.npz").read_bytes()
    model = tmp_path / "cut.npz"
    model.write_bytes(content[: keep if isinstance(keep, int) else int(keep * len(content))])
    assert_refused(run("info", model), "cut.npz")
    assert_refused(run("render", model, "-o", tmp_path / "y.png"), "cut.npz")
    assert not (tmp_path / "y.png").exists()


@pytest.mark.parametrize(
    "options",
    [
        ["--scale", "2", "--size", "10x10"],
        ["--scale", "0"],
        ["--scale", "-1"],
        ["--scale", "nan"],
        ["--scale", "inf"],
        ["--scale", "1e9"],
        ["--size", "10"],
        ["--size", "0x10"],
        ["--size", "10x-1"],
        ["--size", "99999999999x10"],
    ],
)
def test_bad_render_sizes(fitted, tmp_path, options):
    folder, _ = fitted
    assert_refused(run("render", folder / "fit.npz", "-o", tmp_path / "y.png", *options))
    assert not (tmp_path / "y.png").exists()

"""Files of floats and of 16 bits on the command line."""

import json

import numpy as np
import pytest

from _helpers.command import assert_refused, run, said, smooth_pixels, succeeded
from eigengs_dr.gaussian.file import read
from eigengs_dr.image.color import to_coded
from eigengs_dr.image.io import load_image, save_image

FEW = ["--gaussians", 200, "--iterations", 30, "--quiet"]


@pytest.fixture(scope="module")
def sky(tmp_path_factory):
    """A folder with an EXR file of light up to 50, and its fit."""
    folder = tmp_path_factory.mktemp("sky")
    light = smooth_pixels(32, 24).astype(np.float32) / 100
    light[5:9, 7:11] = 50
    save_image(folder / "sky.exr", light)
    report = folder / "r.json"
    preview = folder / "p.png"
    command = ["fit", folder / "sky.exr", "-o", folder / "sky.npz", "--space", "log", *FEW]
    succeeded(run(*command, "--report", report, "--preview", preview))
    return folder, light


def test_fit_of_light(sky):
    folder, _ = sky
    figures = json.loads((folder / "r.json").read_text())
    assert figures["psnr_ycbcr"] > 25 and figures["encoding"] is None
    assert load_image(folder / "p.png").shape[1] > 32
    assert read(folder / "sky.npz").space == "log"


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("y.exr", []),
        ("y.hdr", []),
        ("y.pfm", []),
        ("y.tif", ["--bits", 32]),
        ("h.exr", ["--bits", 16]),
    ],
)
def test_render_writes_light(sky, tmp_path, name, options):
    folder, light = sky
    succeeded(run("render", folder / "sky.npz", "-o", tmp_path / name, *options))
    found = load_image(tmp_path / name)
    assert found.shape == light.shape
    assert found.max() == pytest.approx(50, rel=0.2)
    assert np.median(found) == pytest.approx(np.median(light), rel=0.05)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_render_writes_16_bits_of_srgb(sky, tmp_path, suffix):
    folder, light = sky
    path = tmp_path / f"y{suffix}"
    succeeded(run("render", folder / "sky.npz", "-o", path, "--bits", 16))
    found = load_image(path)
    assert len(np.unique(found)) > 300  # more than 8 bits have
    assert np.median(found) == pytest.approx(np.median(np.clip(to_coded(light), 0, 1)), rel=0.05)


def test_a_fit_of_codes_becomes_light_in_exr(tmp_path):
    save_image(tmp_path / "a.png", smooth_pixels(32, 24))
    succeeded(run("fit", tmp_path / "a.png", "-o", tmp_path / "a.npz", *FEW))
    for name in ("y.png", "y.exr"):
        succeeded(run("render", tmp_path / "a.npz", "-o", tmp_path / name))
    codes = to_coded(np.asarray(load_image(tmp_path / "y.exr")))
    np.testing.assert_allclose(load_image(tmp_path / "y.png"), np.clip(codes, 0, 1), atol=0.003)


def test_encoding_of_the_file_can_be_said(tmp_path):
    save_image(tmp_path / "a.png", smooth_pixels(32, 24))
    command = ["fit", tmp_path / "a.png", "-o", tmp_path / "a.npz", "--space", "linear", *FEW]
    succeeded(run(*command, "--encoding", "linear"))
    succeeded(run("render", tmp_path / "a.npz", "-o", tmp_path / "y.exr"))
    means = [float(load_image(tmp_path / name).mean()) for name in ("a.png", "y.exr")]
    assert means[0] == pytest.approx(means[1], rel=0.02)


def test_data_of_16_bits(tmp_path):
    y, x = np.mgrid[:24, :32]
    heights = (30_000 + 200 * x + 90 * y).astype(np.uint16)
    save_image(tmp_path / "a.png", heights, bits=16)
    command = ["fit", tmp_path / "a.png", "-o", tmp_path / "a.npz", "--space", "data", *FEW]
    succeeded(run(*command))
    succeeded(run("render", tmp_path / "a.npz", "-o", tmp_path / "y.png", "--bits", 16))
    found = np.rint(load_image(tmp_path / "y.png", keep_grey=True) * 65535)[..., 0]
    assert np.abs(found - heights).mean() < 60  # a step of 8 bits is 257


def test_data_beyond_1_have_one_psnr(tmp_path):
    """The trace, the report, rows of many images and a fit by blocks measure in one unit."""
    heights = 2 * smooth_pixels(64, 64).astype(np.float32)[..., 0] - 250
    reports = []
    for name, more in (("one", []), ("blocks", ["--blocks", 32]), ("several", [])):
        folder = tmp_path / name
        folder.mkdir()
        save_image(folder / "a.pfm", heights)
        out, report = folder / "out", tmp_path / f"{name}.json"
        images = [folder / "a.pfm"] if name != "several" else [folder]
        target = [out if name == "several" else folder / "a.npz", "--report", report, *more, *FEW]
        succeeded(run("fit", *images, "--space", "data", "-o", *target))
        found = json.loads(report.read_text())
        reports.append(found["images"][0] if name == "several" else found)
    one, blocks, several = reports
    assert one["psnr_ycbcr"] == one["trace"][-1]["psnr_ycbcr"] > 25
    assert several["psnr_ycbcr"] == one["psnr_ycbcr"]
    assert blocks["psnr_ycbcr"] == pytest.approx(one["psnr_ycbcr"], abs=2)
    goal = ["--target-psnr", 30, "--iterations", 60, "--space", "data", "-o", tmp_path / "few.npz"]
    told = succeeded(run("fit", tmp_path / "one" / "a.pfm", *goal)).output
    assert float(told.split("psnr_data ")[1].split(" dB")[0]) >= 30


def test_pack_and_several_images_of_light(sky, tmp_path):
    folder, _ = sky
    command = ["pack", folder / "sky.npz", "-o", tmp_path / "y.egs", "--image", folder / "sky.exr"]
    assert "psnr in log" in said(*command)
    save_image(tmp_path / "a.pfm", load_image(folder / "sky.exr"))
    options = ["--space", "linear", *FEW]
    succeeded(run("fit", tmp_path / "a.pfm", folder / "sky.exr", "-o", tmp_path / "out", *options))
    assert read(tmp_path / "out" / "sky.npz").space == "radiance"


def test_what_is_refused(sky, tmp_path):
    folder, light = sky
    grey, broken, nan = (tmp_path / f"{name}.exr" for name in ("grey", "broken", "nan"))
    save_image(grey, light[..., :1])
    broken.write_bytes((folder / "sky.exr").read_bytes()[:300])
    content = tmp_path / "nan.pfm"
    light = light.copy()
    light[3, 4] = np.nan
    content.write_bytes(b"PF\n32 24\n-1\n" + light[::-1].tobytes())
    for path, words in (
        (grey, ["holds one channel", "--space data"]),
        (broken, ["damaged or unsupported"]),
        (content, ["not finite", "[3, 4]"]),
    ):
        assert_refused(run("fit", path, "-o", tmp_path / "x.npz"), path, *words)
    assert not nan.exists() and not (tmp_path / "x.npz").exists()
    for name, bits in (("y.jpg", 16), ("y.exr", 8)):
        result = run("render", folder / "sky.npz", "-o", tmp_path / name, "--bits", bits)
        assert_refused(result, name, f"bits is {bits}")
        assert not (tmp_path / name).exists()

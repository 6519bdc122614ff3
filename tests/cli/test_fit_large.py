"""The command `fit` by blocks, and `render` and `info` of what it writes."""

import json

import numpy as np
import pytest
import tifffile
from PIL import Image

from _helpers.command import assert_refused, run, succeeded
from _helpers.mosaics import mosaic
from eigengs_dr.fitting import memory
from eigengs_dr.gaussian import file as setfile

FEW = ["--gaussians", 700, "--iterations", 5]


@pytest.fixture
def photo(tmp_path):
    path = tmp_path / "photo.tif"
    tifffile.imwrite(path, mosaic(128), photometric="rgb", tile=(32, 32))
    return path


def test_fit_by_blocks(photo, tmp_path):
    output, report = tmp_path / "x.npz", tmp_path / "x.json"
    options = ["-o", output, "--blocks", 64, "--report", report]
    result = succeeded(run("fit", photo, *options, *FEW))
    assert "128x128 in 4 blocks, 700 Gaussians" in result.stdout
    figures = json.loads(report.read_text())
    expected = {"blocks": 4, "block": 64, "gaussians": 700, "stopped": "iterations", "width": 128}
    assert {key: figures[key] for key in expected} == expected
    assert figures["psnr_ycbcr"] > figures["psnr_rgb"] > 20
    assert json.loads(run("info", output, "--json").stdout)["gaussians"] == 700
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photo.tif", "x.json", "x.npz"]


def test_blocks_are_chosen_where_memory_says_so(photo, tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "usable_memory", lambda: 200_000_000)
    result = succeeded(run("fit", photo, "-o", tmp_path / "x.npz", "--iterations", 2))
    assert "takes too much memory; it is fitted by blocks" in result.stderr
    assert f"{128 * 128 // 20} Gaussians" in result.stdout
    # Levels of detail have no blocks: such a fit is tried as a whole.
    levels = run("fit", photo, "-o", tmp_path / "y.npz", "--levels", 2, *FEW)
    assert "blocks" not in succeeded(levels).stderr


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--target-psnr", 30], "--target-psnr"),
        (["--levels", 2], "--levels"),
        (["--preview", "x.png"], "--preview"),
        (["--init", "random"], "--blocks needs"),
        (["--blocks", 5], "at least 32"),
        (["--blocks", -1], "at least 32"),
    ],
)
def test_refused_options(photo, tmp_path, options, reason):
    result = run("fit", photo, "-o", tmp_path / "x.npz", "--blocks", 64, *options)
    assert_refused(result, reason)


def test_blocks_take_one_image(photo, tmp_path):
    Image.fromarray(mosaic(64)).save(tmp_path / "b.png")
    result = run("fit", photo, tmp_path / "b.png", "-o", tmp_path / "out", "--blocks", 64)
    assert_refused(result, "--blocks fits one image")


def test_interrupt(photo, tmp_path, monkeypatch):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("eigengs_dr.fit_large", interrupted)
    result = run("fit", photo, "-o", tmp_path / "x.npz", "--blocks", 64, *FEW)
    assert result.exit_code == 130
    assert "the same command goes on" in result.stderr


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    """A set, and its picture."""
    folder = tmp_path_factory.mktemp("large")
    Image.fromarray(mosaic(128)).save(folder / "photo.png")
    succeeded(run("fit", folder / "photo.png", "-o", folder / "x.npz", "--blocks", 64, *FEW))
    succeeded(run("render", folder / "x.npz", "-o", folder / "whole.png"))
    return folder


@pytest.mark.parametrize(
    ("options", "box"),
    [
        (["--region", "30,50,40,20"], (30, 50, 70, 70)),
        (["--region", "0,0,128,128"], (0, 0, 128, 128)),
        (["--region", "127,127,1,1", "--scale", 1], (127, 127, 128, 128)),
    ],
)
@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_region_is_the_crop_of_the_whole(large, tmp_path, options, box, suffix):
    succeeded(run("render", large / "x.npz", "-o", tmp_path / f"y.{suffix}", *options))
    found = np.asarray(Image.open(tmp_path / f"y.{suffix}")).astype(int)
    expected = np.asarray(Image.open(large / "whole.png").crop(box)).astype(int)
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() <= 1


def test_scaled_region(large, tmp_path):
    succeeded(run("render", large / "x.npz", "-o", tmp_path / "double.png", "--scale", 2))
    region = ["--region", "30,50,40,20", "--scale", 2]
    succeeded(run("render", large / "x.npz", "-o", tmp_path / "y.png", *region))
    found = np.asarray(Image.open(tmp_path / "y.png")).astype(int)
    whole = np.asarray(Image.open(tmp_path / "double.png")).astype(int)
    assert np.abs(found - whole[100:140, 60:140]).max() <= 1


@pytest.mark.parametrize(
    "region", ["1,2,3", "a,b,c,d", "0,0,0,5", "-1,0,5,5", "100,0,40,10", "0,120,10,9"]
)
def test_bad_regions(large, tmp_path, region):
    result = run("render", large / "x.npz", "-o", tmp_path / "y.png", "--region", region)
    assert_refused(result, region)
    assert not (tmp_path / "y.png").exists()


def test_picture_that_only_a_tiff_holds(large, tmp_path):
    result = run("render", large / "x.npz", "-o", tmp_path / "y.png", "--scale", 200)
    assert_refused(result, "25600x25600", ".tif")


def test_info_reads_headers_alone(large, monkeypatch):
    def read(*arguments):
        raise AssertionError("the Gaussians were read")

    monkeypatch.setattr(setfile, "read", read)
    facts = json.loads(succeeded(run("info", large / "x.npz", "--json")).stdout)
    expected = {"kind": "image", "gaussians": 700, "width": 128, "height": 128, "channels": 3}
    assert {key: facts[key] for key in expected} == expected

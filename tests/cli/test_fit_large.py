"""The command `fit` by blocks, and the memory that it says or refuses."""

import json

import pytest
import tifffile

from _helpers.command import assert_refused, run, succeeded
from _helpers.files import png
from _helpers.mosaics import mosaic
from eigengs_dr.cli import memory

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
    shown = json.loads(succeeded(run("info", output, "--json")).stdout)
    assert shown["psnr_rgb"] == pytest.approx(figures["psnr_rgb"], abs=0.01)
    assert (shown["iterations"], shown["source"]) == (5, "photo.tif")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photo.tif", "x.json", "x.npz"]


def test_the_number_of_gaussians_does_not_depend_on_memory(photo, tmp_path, monkeypatch):
    """Too little memory is an error that names blocks, where there are such."""
    command = ["fit", photo, "-o", tmp_path / "x.npz", "--iterations", 2]
    assert "5,000 Gaussians" in succeeded(run(*command)).stdout
    monkeypatch.setattr("eigengs_dr.storage.memory.usable_memory", lambda: 200_000_000)
    assert "5,000 Gaussians" in succeeded(run(*command)).stdout
    monkeypatch.setattr("eigengs_dr.storage.memory.usable_memory", lambda: 100_000_000)
    assert_refused(run(*command), "may use 0.1 GB; fit it with --blocks 1024, scale the image down")
    levels = run(*command, "--levels", 2, *FEW)
    assert_refused(levels, "may use 0.1 GB; scale the image down")
    assert "819 Gaussians" in succeeded(run(*command, "--blocks", 64)).stdout


# --- Memory, before the image is read ---


def test_large_fit_says_its_memory(tmp_path):
    """Before it finds that no pixels follow the header."""
    photo, output = tmp_path / "large.png", tmp_path / "x.npz"
    photo.write_bytes(png(8000, 8000, 8, 2, []))
    command = ["fit", photo, "-o", output, "--preview", tmp_path / "p.png"]  # blocks have none
    line = "eigengs-dr: 5,000 Gaussians on 8000x8000 pixels take about 6."
    assert run(*command).stderr.startswith(line)
    assert not run(*command, "--quiet").stderr.startswith(line)


@pytest.mark.parametrize(
    ("grey", "options", "expected"),
    [
        (False, ["--gaussians", 70], (3, "70")),
        (False, ["--target-psnr", 30], (3, "500,000")),
        (True, [], (3, "5,000")),
        (True, ["--space", "data"], (1, "5,000")),
    ],
)
def test_a_fit_that_does_not_fit_is_refused(tmp_path, monkeypatch, grey, options, expected):
    """Grey becomes RGB, and a search starts with one Gaussian for 64 pixels."""
    monkeypatch.setattr("eigengs_dr.storage.memory.usable_memory", lambda: 1)
    path = tmp_path / "large.png"
    path.write_bytes(png(8000, 4000, 8, 0 if grey else 2, []))
    outputs = ["-o", tmp_path / "x.npz", "--preview", tmp_path / "p.png"]
    channels, count = expected
    needed = memory.estimate_memory(8000, 4000, channels, int(count.replace(",", "")))
    words = f"{count} Gaussians on 8000x4000 pixels take about {needed / 1e9:.1f} GB"
    result = run("fit", path, *outputs, *options)
    assert_refused(result, path, words, "this process may use 0.0 GB", "scale the image down")

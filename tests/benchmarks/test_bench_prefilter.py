"""The prefilter beside mip maps: the mip map against means, and the order of the methods."""

import json

import numpy as np
import pytest

from _helpers.benchmarks import run
from eigengs_dr.image.io import sample, save_image

pytest.importorskip("mitsuba", reason="the plugins need mitsuba")

from eigengs_bench.experiments import prefilter


@pytest.fixture(autouse=True)
def few(monkeypatch):
    settings = {"LOOKUPS": 500, "GAUSSIANS": 300, "STEPS": 10, "PIXELS": ((4, 1), (2, 4))}
    for name, value in settings.items():
        monkeypatch.setattr(prefilter, name, value)


def test_the_command_compares_methods(tmp_path):
    photo, report = tmp_path / "brick.png", tmp_path / "report.json"
    save_image(photo, sample("brick")[:64, :64])
    told = run("bench", "prefilter", photo, "--report", report)
    assert told.exit_code == 0, told.output
    assert "texels x slant" in told.stdout
    for row in json.loads(report.read_text())["results"]:
        assert row["prefilter"] > row["trilinear"] > row["point"]
    save_image(photo, sample("brick")[:64, :48])
    wrong = run("bench", "prefilter", photo)
    assert wrong.exit_code == 2 and "use a square of 2^n pixels" in wrong.stderr


def pixels(sample, texels, slant, turn=0.0):
    along = np.array([np.cos(turn), np.sin(turn)])
    sides = texels * np.stack([slant * along, [-along[1], along[0]]], 1)
    at = np.tile(np.array(sample, float), (500, 1))
    return prefilter.Pixels(at, np.tile(sides, (500, 1, 1)), texels, slant)


def test_levels_are_means_of_blocks():
    """In the middle of a block of 4 x 4 texels its mean; between two levels the mean of both."""
    picture = np.random.default_rng(0).random((16, 16, 3)).astype(np.float32)
    levels = prefilter.mip_map(picture)
    assert [len(level) for level in levels] == [16, 8, 4, 2, 1]
    block = picture[4:8, 8:12].mean(axis=(0, 1))
    found = prefilter.trilinear(levels, pixels((10, 6), 4, 1))
    np.testing.assert_allclose(found[0], block, atol=1e-6)
    finer = prefilter.trilinear(levels, pixels((10, 6), 2, 1))
    between = prefilter.trilinear(levels, pixels((10, 6), 8**0.5, 1))
    np.testing.assert_allclose(between[0], (finer[0] + block) / 2, atol=1e-6)


def test_taps_run_along_the_long_side():
    """A ramp across the pixel keeps its value; stripes across its long side are averaged out."""
    y, x = np.mgrid[:64, :64] + 0.5
    ramp, stripes = y / 64, (np.floor(x) % 2)
    levels = prefilter.mip_map(np.stack([ramp, stripes, ramp], 2).astype(np.float32))
    found = prefilter.trilinear(levels, pixels((32, 20.5), 1, 8), taps=16)
    np.testing.assert_allclose(found[0, 0], 20.5 / 64, atol=1e-3)
    np.testing.assert_allclose(found[0, 1], 0.5, atol=0.05)


def test_the_reference_is_the_mean_over_the_pixel():
    """Samples lie anywhere in their pixels, so means of a ramp differ from samples by a box."""
    seen = pixels((10.0, 10.0), 2, 4)
    found = prefilter.mean_over(lambda at: np.repeat(at[:, :1], 3, axis=1), seen)[:, 0] - 10
    assert np.abs(found).max() < 4 and abs(found.mean()) < 0.3
    assert found.std() == pytest.approx(8 / 12**0.5, rel=0.1)

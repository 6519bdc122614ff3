"""Kernels, starts and textures on scenes so small that only their arithmetic is tested."""

import json

import numpy as np
import pytest

from _helpers.benchmarks import family, one_image, run, small_model
from eigengs_bench.experiments import eigen, kernels
from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.fit import fit
from eigengs_dr.image.io import save_image
from eigengs_dr.image.metrics import psnr
from eigengs_dr.raster.render import render

FIGURES = {"plain_ms", "fast_ms", "peak_evals_per_ns", "forward_peak_fraction", "growth"}


@pytest.fixture
def small(monkeypatch):
    for name, value in {"SIDE": 64, "COUNT": 300, "ROUNDS": 2, "PEAK_LANES": 1 << 10}.items():
        monkeypatch.setattr(kernels, name, value)


def test_every_figure_is_there_and_positive(small, backend, tmp_path):
    report = tmp_path / "r.json"
    told = run("bench", "kernels", "--backend", backend, "--report", report)
    assert told.exit_code == 0, told.output
    figures = json.loads(report.read_text())
    assert set(figures) >= {*FIGURES, "command", "commit", "clean", "versions"}
    assert all(figures[name] > 0 for name in FIGURES)
    assert figures["step_ratio"] == pytest.approx(figures["plain_ms"] / figures["fast_ms"])
    assert all(name in told.stdout for name in FIGURES)


@pytest.fixture
def scene(small, backend):
    return kernels.random_scene(types_in(select(backend)))


def test_both_renderers_draw_the_same_picture(scene):
    """Pixel by pixel, and what is timed is what is shown: its pixels sum up to as much."""
    pictures = {}
    for plain in (True, False):
        forward, _, shown = kernels.programs(scene, kernels.CUTOFF, plain)
        pictures[plain] = shown()
        timed = forward().numpy()
        forward.func.clear()
        assert timed.sum() == pytest.approx(pictures[plain].sum(), rel=1e-4)
    assert pictures[True].shape == (64, 64, 3) and np.std(pictures[True]) > 0.1
    np.testing.assert_allclose(pictures[False], pictures[True], atol=1e-4)
    expected = render(scene, cutoff=kernels.CUTOFF).numpy()
    np.testing.assert_allclose(pictures[False], expected, atol=1e-4)
    assert np.abs(pictures[False][::-1] - expected).max() > 0.1  # a picture that differs is seen


def test_pixels_inside_are_counted_as_by_hand(scene):
    mean = scene.to_arrays()["mean"].astype(float)
    rows, columns = np.indices((64, 64)) + 0.5
    inside = sum(
        ((columns - x) ** 2 + (rows - y) ** 2 <= (kernels.CUTOFF * kernels.SIGMA) ** 2).sum()
        for x, y in mean
    )
    assert kernels.pixels_inside(scene) == inside


@pytest.mark.parametrize("iterations", [0, 10])
def test_starts_are_compared(backend, iterations):
    """Figures are those of the functions they are named after."""
    model, images, seen = small_model(backend), list(family(2, seed=3)), []
    figures = eigen.run(model, images, iterations, lambda *done: seen.append(done))
    assert seen == [("eigen", 1, 2), ("eigen", 2, 2)]
    for start in ("projected", "exact", "solved", "grid", "adaptive"):
        assert figures[f"{start}_seconds"] > 0
        assert figures[f"{start}_psnr_ycbcr"] > figures[f"{start}_psnr_rgb"] > 15
    grids = [fit(image, 100, iterations, init="grid", backend=backend).image for image in images]
    expected = np.mean([psnr(*pair) for pair in zip(grids, images, strict=True)])
    assert figures["grid_psnr_rgb"] == pytest.approx(expected)
    if iterations == 0:
        shown = [render(model.encode(image, "projected")) for image in images]
        expected = np.mean([psnr(*pair) for pair in zip(shown, images, strict=True)])
        assert figures["projected_psnr_rgb"] == pytest.approx(expected)
    assert figures["encode_exact_ms"] > 0


def test_the_command_compares_starts(backend, tmp_path):
    (tmp_path / "photos").mkdir()
    save_image(tmp_path / "photos" / "a.png", one_image())
    small_model(backend).save(tmp_path / "basis.npz")
    arguments = (tmp_path / "basis.npz", tmp_path / "photos", "--iterations", 1)
    told = run("bench", "eigen", *arguments, "--backend", backend)
    assert told.exit_code == 0 and "encode_exact_ms" in told.stdout


def test_textures_are_timed_against_a_bitmap(monkeypatch):
    mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")
    from eigengs_bench.experiments import texture

    small = {"SIDE": 16, "TEXELS": 32, "SPP": 1, "COUNTS": (50, 100), "SETTLED": 100}
    small["CHANGED"] = (100, 150)
    for name, value in {**small, "STEPS": 2, "ROUNDS": 1}.items():
        monkeypatch.setattr(texture, name, value)
    before, calls = mi.variant(), []
    figures = texture.run(progress=lambda *step: calls.append(step))
    if before:
        mi.set_variant(before)
    expected = {"ratio_50", "ratio_100", "ratio_prefiltered", "ratio_step"}
    expected |= {"change_100_ms", "change_filtered_150_ms"}
    assert expected <= set(figures)
    assert all(value > 0 for value in figures.values())
    assert figures["difference"] <= 1e-4
    assert calls[-1] == ("texture", 3, 3)


def test_an_environment_map_is_fitted_in_several_ways(tmp_path):
    from eigengs_bench.experiments.radiance import run as fit_environment

    figures, results = fit_environment(width=64, gaussians=200, iterations=30)
    assert results["reference"].shape == (32, 64, 3)
    assert results["reference"].max() > 10
    assert figures["pu21_log"] > figures["pu21_8bit"]

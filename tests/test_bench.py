"""The benchmarks on a scene so small that only their arithmetic is tested."""

import numpy as np
import pytest
from scenes import family, small_model

from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.bench import eigen, kernels
from eigengs_dr.fitting.fit import fit
from eigengs_dr.image.metrics import psnr
from eigengs_dr.raster.render import render

FIGURES = {
    "plain_ms",
    "fast_ms",
    "step_ratio",
    "forward_ratio",
    "peak_evals_per_ns",
    "forward_peak_fraction",
    "step_peak_fraction",
    "growth",
}


@pytest.fixture
def small(monkeypatch):
    for name, value in {"SIDE": 64, "COUNT": 300, "ROUNDS": 2, "PEAK_LANES": 1 << 10}.items():
        monkeypatch.setattr(kernels, name, value)


def test_every_figure_is_there_and_positive(small, backend):
    calls = []
    figures = kernels.run(backend=backend, progress=lambda done, total, row: calls.append(done))
    assert set(figures) >= FIGURES
    assert all(np.isfinite(value) and value > 0 for value in figures.values())
    assert figures["step_ratio"] == pytest.approx(figures["plain_ms"] / figures["fast_ms"])
    assert calls == sorted(calls)


def test_both_renderers_draw_the_same(small, backend, monkeypatch):
    """What is timed against each other makes equal pixels, in another order."""
    shown = {}

    def called(variants, progress):
        shown.update({name: variants[f"{name}_forward_ms"]().numpy() for name in ("plain", "fast")})
        return dict.fromkeys(variants, 1.0)

    monkeypatch.setattr(kernels, "_interleaved", called)
    types = types_in(select(backend))
    kernels._kernel_figures(types, kernels._scene(types), None)
    assert np.allclose(np.sort(shown["plain"]), np.sort(shown["fast"]), atol=1e-4)


def test_pixels_inside_are_counted_as_by_hand(small, backend):
    scene = kernels._scene(types_in(select(backend)))
    mean = scene.to_arrays()["mean"].astype(float)
    rows, columns = np.indices((64, 64)) + 0.5
    inside = sum(
        ((columns - x) ** 2 + (rows - y) ** 2 <= (kernels.CUTOFF * kernels.SIGMA) ** 2).sum()
        for x, y in mean
    )
    assert kernels._pixels_inside(scene) == inside


def test_a_small_image_is_refused(backend):
    with pytest.raises(ValueError, match="must be at least 512x512"):
        kernels.run(np.zeros((100, 600, 3), np.float32), backend=backend)


@pytest.mark.parametrize("iterations", [0, 10])
def test_starts_are_compared(backend, iterations):
    """Figures are those of the functions they are named after."""
    model, images, seen = small_model(backend), list(family(2, seed=3)), []
    figures = eigen.run(model, images, iterations, lambda *done: seen.append(done))
    assert seen == [(1, 2), (2, 2)]
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


def test_textures_are_timed_against_a_bitmap(monkeypatch):
    mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")
    from eigengs_dr.bench import texture

    small = {"SIDE": 16, "TEXELS": 32, "SPP": 1, "COUNTS": (50, 100), "SETTLED": 100}
    for name, value in {**small, "STEPS": 2, "ROUNDS": 1}.items():
        monkeypatch.setattr(texture, name, value)
    before, calls = mi.variant(), []
    figures = texture.run(progress=lambda done, total, row: calls.append((done, total)))
    if before:
        mi.set_variant(before)
    assert {"ratio_50", "ratio_100", "ratio_prefiltered", "ratio_step", "change_ms"} <= set(figures)
    assert all(value > 0 for value in figures.values())
    assert figures["difference"] <= 1e-4
    assert calls[-1][0] == calls[-1][1]

"""Speed against accuracy: the front, what is measured, and how it is shown."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from _helpers.benchmarks import RUN, lines_of, one_image, run, small_model, task_in
from eigengs_bench.experiments import kernels, pareto
from eigengs_bench.experiments.pareto import Variant
from eigengs_bench.harness.timing import follow
from eigengs_bench.report.frames import frame_of
from eigengs_bench.report.sections.pareto import front, points_of, summarize
from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.fitting.descent import descend
from eigengs_dr.fitting.fit import fit
from eigengs_dr.fitting.options import PRESETS, FitOptions
from eigengs_dr.fitting.start import initialize
from eigengs_dr.image.metrics import psnr
from eigengs_dr.raster.reference import render_exact
from eigengs_dr.raster.render import picture_of

COORDINATES = st.sampled_from([0.0, 0.5, 1.0, 2.0, 3.0, float("nan")])


@given(st.lists(st.tuples(COORDINATES, COORDINATES), max_size=12))
def test_front_is_what_nothing_beats(points):
    known = {p for p in points if p[0] == p[0] and p[1] == p[1]}
    beaten = {p for p in known for q in known if q != p and q[0] <= p[0] and q[1] >= p[1]}
    assert front(points) == sorted(known - beaten)


def test_variants_turn_one_setting_each(tmp_path, monkeypatch):
    monkeypatch.setattr(pareto, "is_trained", lambda data, name: True)
    monkeypatch.setattr(pareto, "model_for", lambda task, name, source, k: f"model {k}")
    base, *others = pareto.variants(task_in(tmp_path), "faces256")
    assert base == Variant("preset", "default", 5000)
    assert len({v[:2] for v in others}) == len(others) == 20
    fields = {"solve steps": "solve_steps", "init": "init", "cutoff": "cutoff"}
    for v in others:
        if v.knob in fields or v.knob == "gaussians":
            if v.value != "eigen":  # whose model sets their number
                assert getattr(v, fields.get(v.knob, "gaussians")) == v.value
                assert sum(a != b for a, b in zip(v[2:], base[2:], strict=True)) == 1
        else:
            assert v.preset == ("eigengs" if v.knob == "components" else v.value)
    models = {v.start for v in others if v.knob == "components"}
    assert models == {"model 50", "model 100", "model 500"}
    assert others[1].start == "model 300" and {v.preset for v in others} == set(PRESETS)


@pytest.fixture
def shorter(monkeypatch):
    monkeypatch.setattr(pareto, "HORIZONS", (0, 4, 1000))
    monkeypatch.setattr(pareto, "MARKS", (0, 2, 1000))


def test_every_horizon_of_falling_rates_is_a_run_of_its_own(shorter, backend, tmp_path):
    image = one_image()
    task = task_in(tmp_path, backend, iterations=12)
    row = pareto.trace(task, Variant("preset", "default", 100), image)
    assert [figures["iteration"] for figures in row["trace"]] == [0, 4, 12]
    assert row["gaussians"] == 100
    for figures in row["trace"]:
        last = fit(image, 100, iterations=figures["iteration"], backend=backend).trace[-1]
        assert figures["psnr_ycbcr"] == pytest.approx(last["psnr_ycbcr"], abs=1e-6)


def test_constant_rates_need_one_run(shorter, backend, monkeypatch, tmp_path):
    runs, model = [], small_model(backend)
    monkeypatch.setattr(pareto, "follow", lambda *a, **k: runs.append(a[2]) or follow(*a, **k))
    variant = Variant("preset", "eigengs", None, "eigengs", start=model)
    row = pareto.trace(task_in(tmp_path, backend, iterations=5), variant, one_image())
    assert [figures["iteration"] for figures in row["trace"]] == [0, 2, 5]
    assert runs == [5]
    start = fit(one_image(), iterations=0, preset="eigengs", start=model, backend=backend)
    assert row["trace"][0]["psnr_ycbcr"] == pytest.approx(start.trace[0]["psnr_ycbcr"], abs=1e-6)


def test_fits_are_made_and_seen_at_their_cutoff(shorter, backend, tmp_path):
    """What splats leave out at 2 sigma is in the second figure, and fitted for in the first."""
    image, variant = one_image(), Variant("cutoff", 2.0, 100, cutoff=2.0)
    row = pareto.trace(task_in(tmp_path, backend, iterations=10), variant, image)
    end = row["trace"][-1]
    assert end["psnr_ycbcr"] > end["psnr_wide"] + 1
    options = FitOptions(gaussians=100, cutoff=2.0, backend=backend)
    *_, gaussians = descend(initialize(image, options), options.method.schedule, 10)
    for cutoff, figure in ((2.0, "psnr_ycbcr"), (6.0, "psnr_wide")):
        shown = psnr(picture_of(gaussians, cutoff=cutoff), image, "ycbcr")
        assert end[figure] == pytest.approx(shown, abs=1e-4)


@pytest.mark.parametrize(("bits", "seed"), [(1, 0), (3, 1), (12, 2)])
def test_quantized_values_are_the_nearest_of_few(bits, seed):
    values = np.random.default_rng(seed).normal(size=(50, 3)) * [1, 100, 0] + [0, 5, 7]
    kept = pareto.quantized(values, bits)
    step = np.ptp(values, axis=0) / (2**bits - 1)
    assert (np.abs(kept - values) <= step / 2 + 1e-9).all()
    assert all(len(np.unique(column)) <= 2**bits for column in kept.T)
    assert (kept[:, 2] == 7).all()


def test_storage_is_counted_and_looked_at(backend):
    image = one_image()
    gaussians = fit(image, 100, iterations=20, backend=backend).gaussians
    rows = {row["precision"]: row for row in pareto.stored(gaussians, image, backend)}
    exact = psnr(picture_of(gaussians), image, "ycbcr")
    assert rows["float32"]["psnr_ycbcr"] == pytest.approx(exact, abs=1e-9)
    assert rows["8 bits"]["psnr_ycbcr"] < rows["12 bits"]["psnr_ycbcr"] < exact + 0.1
    # 100 splats of 8 numbers; two float32 ends of 8 ranges; 3 float32 of the background.
    sizes = {"8 bits": 800 + 64, "10 bits": 1000 + 64, "float16": 1600, "float32": 3200}
    assert all(rows[name]["bytes"] == size + 12 for name, size in sizes.items())


@pytest.fixture
def small_kernels(monkeypatch):
    for name, value in {"SIDE": 64, "COUNT": 300, "WARM_UP": 1, "ROUNDS": 1}.items():
        monkeypatch.setattr(kernels, name, value)


def test_the_error_of_a_cutoff_is_what_it_leaves_out(small_kernels, monkeypatch, backend, tmp_path):
    monkeypatch.setattr(pareto, "CUTOFFS", (2.5, 3.5))
    rows = pareto._kernels(task_in(tmp_path, backend))["kernels"]
    arrays = kernels.random_scene(types_in(select(backend))).to_arrays()
    order = ("mean", "factor", "color", "background")
    whole, cut = (render_exact(*map(arrays.get, order), 64, 64, cut) for cut in (np.inf, 3.5))
    order = [(row["renderer"], row["cutoff"]) for row in rows]
    assert order == list(zip(2 * ["fast", "plain"], [2.5, 2.5, 3.5, 3.5], strict=True))
    for row in rows[2:]:
        assert row["largest_error"] == pytest.approx(np.abs(whole - cut).max(), rel=1e-3)
        rms = np.sqrt(np.mean((whole - cut) ** 2))
        assert row["rms_error"] == pytest.approx(rms, rel=1e-2)
        assert row["forward_ms"] > 0 and row["step_ms"] > 0


# --- How it is shown ---


def row_of(image, knob, value, *trace):
    figures = ("iteration", "seconds", "psnr_ycbcr", "psnr_rgb", "psnr_wide")
    return {
        "job": {"set": "cats", "image": image, "knob": knob, "value": value},
        "gaussians": 7 if knob == "gaussians" else 5,
        "trace": [dict(zip(figures, line, strict=True)) for line in trace],
        "run": RUN,
    }


def made_rows():
    return [
        row_of("a", "preset", "default", (0, 1.0, 30.0, 24.0, 29.0), (9, 2.0, 40.0, 34.0, 39.0)),
        row_of("b", "preset", "default", (0, 3.0, 32.0, 26.0, 31.0), (9, 8.0, 44.0, 38.0, 43.0)),
        row_of("a", "cutoff", 2.5, (0, 2.0, 30.0, 24.0, 20.0), (9, 4.0, 41.0, 35.0, 30.0)),
        row_of("a", "gaussians", 7, (0, 1.5, 33.0, 20.0, 20.0)),
        row_of("b", "gaussians", 7, (0, 1.5, 33.0, 20.0, 20.0)),
        row_of("b", "cutoff", 2.5, (0, 4.0, 30.0, 24.0, 20.0), (9, 4.0, None, 35.0, 30.0)),
    ]


def test_points_are_medians_of_seconds_and_means_of_decibels():
    points = points_of(frame_of(made_rows(), "trace"))
    assert points.seconds.tolist() == [2.0, 5.0, 3.0, 4.0, 1.5]
    assert points.psnr_ycbcr.tolist()[:3] == [31.0, 42.0, 30.0]
    assert np.isnan(points.psnr_ycbcr[3]) and points.psnr_ycbcr[4] == 33.0
    assert points.front.tolist() == [0, 1, 0, 0, 1]
    assert points.front_same.tolist() == [1, 1, 0, 0, 0]
    assert points.psnr_wide[1] == 41.0 and points.images.tolist() == [2] * 5


def test_tables_tell_what_is_on_the_front():
    told = summarize(made_rows())
    (table,) = told.tables
    assert " | ".join(lines_of(table)[0]) == (
        "preset default | 2.000 (1.500-2.500) | 31.0 ± 1.4 | 5.00 (3.50-6.50) | 42.0 ± 2.8 | "
        "36.0 ± 2.8 | 41.0 ± 2.8 | 9 | 0, 9"
    )
    assert lines_of(table)[1][0] == "cutoff 2.5" and lines_of(table)[1][-2:] == ("-", "-")
    assert list(told.charts) == ["pareto-cats"]


@pytest.fixture
def small(monkeypatch, shorter, small_kernels):
    """Fits so small and few that only what is done with them is tested."""
    monkeypatch.setattr("eigengs_bench.harness.datasets.SAMPLE_SIDE", 32)
    monkeypatch.setattr(pareto, "usual_count", lambda name: 100)
    monkeypatch.setattr(pareto, "CUTOFFS", (3.5,))
    monkeypatch.setattr(EigenGS, "load", lambda name, backend: small_model(backend or "llvm"))
    whole = pareto.variants
    monkeypatch.setattr(pareto, "variants", lambda *a: [whole(*a)[k] for k in (0, 2, 10)])


def test_the_command_measures_draws_and_goes_on(small, backend, tmp_path):
    out = tmp_path / "out"
    arguments = ("-o", out, "--images", 1, "--iterations", 3, "--backend", backend)
    told = run("bench", "pareto", *arguments)
    assert told.exit_code == 0, told.output
    for text in ("preset eigengs", "cutoff 2.5", "samples float16", "plain 3.5", "samples.svg"):
        assert text in told.stdout
    files = ["pareto.jsonl"]
    files += [f"pareto-{name}.svg" for name in ("samples", "storage", "kernels")]
    kept = {name: (out / name).read_bytes() for name in files}
    rows = [json.loads(line) for line in kept["pareto.jsonl"].splitlines()]
    assert len(rows) == 3 + 2
    assert {(row["job"]["seed"], row["job"]["iterations"]) for row in rows[:-1]} == {(0, 3)}
    assert b"front: none is better" in kept["pareto-samples.svg"]
    assert run("bench", "pareto", *arguments).stdout == told.stdout
    assert kept == {name: (out / name).read_bytes() for name in files}

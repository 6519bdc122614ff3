"""Speed against accuracy: the front, what is measured, and how it is shown."""

import csv
import json
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from scenes import family, few, small_model

import eigengs_dr as eg
from eigengs_dr import cli_pareto
from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.bench import kernels, pareto, pareto_kernels, pareto_tables, sets
from eigengs_dr.bench.pareto import Collection, Variant, front
from eigengs_dr.cli import options as cli_shared
from eigengs_dr.cli.console import Program
from eigengs_dr.fitting.initializers import initialize
from eigengs_dr.fitting.optimizers.descent import descend
from eigengs_dr.fitting.presets import PRESETS
from eigengs_dr.raster.reference import render_exact
from eigengs_dr.raster.render import picture_of

COORDINATES = st.sampled_from([0.0, 0.5, 1.0, 2.0, 3.0, float("nan")])
FILES = ["pareto.jsonl", "pareto-samples.csv"]
FILES += [f"pareto-{name}.svg" for name in ("samples", "storage", "kernels")]


@given(st.lists(st.tuples(COORDINATES, COORDINATES), max_size=12))
def test_front_is_what_nothing_beats(points):
    known = {p for p in points if p[0] == p[0] and p[1] == p[1]}
    beaten = {p for p in known for q in known if q != p and q[0] <= p[0] and q[1] >= p[1]}
    assert front(points) == sorted(known - beaten)


def small_collection(backend, side=32):
    image = family(1, side=side, seed=5)[0]
    return Collection("small", [("one", image)], 100, small_model(backend), {})


def test_variants_turn_one_setting_each(backend):
    model = small_model(backend)
    base, *others = pareto.variants(small_collection(backend)._replace(others={7: model}))
    assert base == Variant("preset", "default", 100)
    assert len({v[:2] for v in others}) == len(others) > 15
    fields = {"solve steps": "solve_steps", "init": "init", "cutoff": "cutoff"}
    for v in others:
        if v.knob in fields or v.knob == "gaussians":
            field = fields.get(v.knob, "gaussians")
            assert getattr(v, field) == v.value != getattr(base, field)
            if v.value != "eigen":  # whose model sets their number
                assert sum(a != b for a, b in zip(v[2:], base[2:], strict=True)) == 1
        else:
            assert v.preset == ("eigengs" if v.knob == "components" else v.value)
    assert {v.preset for v in others} == set(PRESETS)


@pytest.fixture
def shorter(monkeypatch):
    monkeypatch.setattr(pareto, "HORIZONS", (0, 4, 1000))
    monkeypatch.setattr(pareto, "MARKS", (0, 2, 1000))


def test_every_horizon_of_falling_rates_is_a_run_of_its_own(shorter, backend):
    image = small_collection(backend).images[0][1]
    row = pareto._fitted(Variant("preset", "default", 100), image, 12, 0, backend)
    assert [figures["iteration"] for figures in row["trace"]] == [0, 4, 12]
    assert row["gaussians"] == 100
    for figures in row["trace"]:
        fit = eg.fit(image, 100, iterations=figures["iteration"], backend=backend)
        assert fit.trace[-1]["iteration"] == figures["iteration"]
        assert figures["psnr_ycbcr"] == pytest.approx(fit.trace[-1]["psnr_ycbcr"], abs=1e-6)


def test_constant_rates_need_one_run(shorter, backend, monkeypatch):
    runs = []
    monkeypatch.setattr(pareto, "follow", lambda *a, **k: runs.append(a[2]) or FOLLOW(*a, **k))
    image = small_collection(backend).images[0][1]
    fit = Variant("preset", "eigengs", None, "eigengs", basis=small_model(backend))
    row = pareto._fitted(fit, image, 5, 0, backend)
    assert [figures["iteration"] for figures in row["trace"]] == [0, 2, 5]
    assert runs == [5]
    encoded = small_model(backend).encode(image, "projected", "dense").bounded()
    dense = small_model(backend).dense_mean(32, 32)
    shown = eg.color.ycbcr_to_rgb(dense) + picture_of(encoded)
    shown -= eg.color.ycbcr_to_rgb(np.zeros((1, 1, 3), np.float32))
    start = row["trace"][0]
    assert start["psnr_ycbcr"] == pytest.approx(eg.psnr(shown, image, "ycbcr"), abs=1e-3)


FOLLOW = pareto.follow


def test_fits_are_made_and_seen_at_their_cutoff(shorter, backend):
    """What splats leave out at 2 sigma is in the second figure, and fitted for in the first."""
    image = small_collection(backend).images[0][1]
    row = pareto._fitted(Variant("cutoff", 2.0, 100, cutoff=2.0), image, 10, 0, backend)
    end = row["trace"][-1]
    assert end["psnr_ycbcr"] > end["psnr_wide"] + 1
    start = initialize(image, 100, "auto", "", PRESETS["default"], cutoff=2.0, backend=backend)
    sets = descend(start.gaussians, start.target, PRESETS["default"].schedule, 10, cutoff=2.0)
    *_, gaussians = sets
    for cutoff, figure in ((2.0, "psnr_ycbcr"), (6.0, "psnr_wide")):
        shown = eg.psnr(picture_of(gaussians, cutoff=cutoff), image, "ycbcr")
        assert end[figure] == pytest.approx(shown, abs=1e-4)


@few
@given(st.integers(1, 12), st.integers(0, 100))
def test_quantised_values_are_the_nearest_of_few(bits, seed):
    values = np.random.default_rng(seed).normal(size=(50, 3)) * [1, 100, 0] + [0, 5, 7]
    kept = pareto.quantised(values, bits)
    step = np.ptp(values, axis=0) / (2**bits - 1)
    assert (np.abs(kept - values) <= step / 2 + 1e-9).all()
    assert all(len(np.unique(column)) <= 2**bits for column in kept.T)
    assert (kept[:, 2] == 7).all()


def test_storage_is_counted_and_looked_at(backend):
    image = small_collection(backend).images[0][1]
    gaussians = eg.fit(image, 100, iterations=20, backend=backend).gaussians
    rows = {row["precision"]: row for row in pareto.stored(gaussians, image, backend)}
    exact = eg.psnr(picture_of(gaussians), image, "ycbcr")
    assert rows["float32"]["psnr_ycbcr"] == pytest.approx(exact, abs=1e-9)
    assert rows["8 bits"]["psnr_ycbcr"] < rows["12 bits"]["psnr_ycbcr"] < exact + 0.1
    # 100 splats of 8 numbers; two float32 ends of 8 ranges; 3 float32 of the background.
    sizes = {"8 bits": 800 + 64, "10 bits": 1000 + 64, "float16": 1600, "float32": 3200}
    assert all(rows[name]["bytes"] == size + 12 for name, size in sizes.items())


@pytest.fixture
def small_kernels(monkeypatch):
    for name, value in {"SIDE": 64, "COUNT": 300, "WARM_UP": 1, "ROUNDS": 1}.items():
        monkeypatch.setattr(kernels, name, value)


def test_the_error_of_a_cutoff_is_what_it_leaves_out(small_kernels, backend):
    _, work = pareto_kernels.kernel_job(backend)
    rows = work()["kernels"]
    arrays = kernels._scene(types_in(select(backend))).to_arrays()
    order = ("mean", "factor", "color", "background")
    whole, cut = (render_exact(*map(arrays.get, order), 64, 64, cut) for cut in (np.inf, 3.5))
    assert {(row["renderer"], row["cutoff"]) for row in rows} == {
        (renderer, cutoff) for renderer in ("fast", "plain") for cutoff in pareto_kernels.CUTOFFS
    }
    for renderer in ("fast", "plain"):
        mine = [row for row in rows if row["renderer"] == renderer]
        errors = [row["rms_error"] for row in mine]
        assert errors == sorted(errors, reverse=True)
        assert errors[-1] < 1e-5
        assert mine[2]["largest_error"] == pytest.approx(np.abs(whole - cut).max(), rel=1e-3)
        rms = np.sqrt(np.mean((whole - cut) ** 2))
        assert mine[2]["rms_error"] == pytest.approx(rms, rel=1e-2)
        assert all(row["forward_ms"] > 0 and row["step_ms"] > 0 for row in mine)


def row_of(image, knob, value, *trace):
    figures = ("iteration", "seconds", "psnr_ycbcr", "psnr_rgb", "psnr_wide")
    job = {"set": "cats", "image": image, "knob": knob, "value": value}
    count = 7 if knob == "gaussians" else 5
    return {
        "job": job,
        "gaussians": count,
        "trace": [dict(zip(figures, line, strict=True)) for line in trace],
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


def test_points_are_medians_of_seconds_and_means_of_decibels(tmp_path):
    found = pareto_tables.points(made_rows(), "cats")
    assert [p.place for p in found[:3]] == [(2.0, 31.0), (5.0, 42.0), (3.0, 30.0)]
    assert found[4].place == (1.5, 33.0)
    assert [p.front for p in found] == [False, True, False, False, True]
    assert [p.front_same for p in found] == [True, True, False, False, False]
    pareto_tables.save_points(tmp_path / "points.csv", found)
    lines = list(csv.DictReader((tmp_path / "points.csv").open()))
    assert [line["front"] for line in lines] == ["0", "1", "0", "0", "1"]
    assert lines[0]["front_same"] == "1"
    assert lines[1]["psnr_wide"] == "41.0"
    assert lines[1]["iteration"] == "9"
    assert lines[3]["psnr_ycbcr"] == "nan"
    assert pareto_tables.points(made_rows(), "dogs") == []


def test_tables_tell_what_is_on_the_front():
    (table,) = pareto_tables.tables(made_rows())
    assert table.rows[0] == (
        "preset default",
        "2.000 (1.500-2.500)",
        "31.0 ± 1.4",
        "5.00 (3.50-6.50)",
        "42.0 ± 2.8",
        "36.0 ± 2.8",
        "41.0 ± 2.8",
        "9",
        "0, 9",
    )
    assert table.rows[1][0] == "cutoff 2.5"
    assert table.rows[1][-2:] == ("-", "-")
    assert len(table.columns) == 9


def bench(*arguments):
    group = Program("bench")
    group.add_command(cli_pareto.pareto)
    return CliRunner().invoke(group, ["pareto", *map(str, arguments)])


@pytest.fixture
def small(monkeypatch, shorter, small_kernels):
    """Fits so small and few that only what is done with them is tested."""
    monkeypatch.setattr(pareto, "SAMPLE_SIDE", 32)
    monkeypatch.setattr(pareto, "GAUSSIANS", 100)
    monkeypatch.setattr(pareto_kernels, "CUTOFFS", (3.5,))
    monkeypatch.setattr(pareto, "load_basis", lambda name, backend: small_model(backend or "llvm"))
    whole = pareto.variants
    monkeypatch.setattr(pareto, "variants", lambda c: [whole(c)[k] for k in (0, 2, 10)])


def test_the_command_measures_draws_and_goes_on(small, backend, tmp_path):
    arguments = ("-o", tmp_path / "out", "--images", 1, "--iterations", 3, "--backend", backend)
    told = bench(*arguments)
    assert told.exit_code == 0, told.output
    for text in (
        "preset eigengs",
        "cutoff 2.5",
        "samples float16",
        "plain 3.5",
        "samples.svg",
    ):
        assert text in told.output
    kept = {name: (tmp_path / "out" / name).read_bytes() for name in FILES}
    rows = [json.loads(line) for line in kept["pareto.jsonl"].splitlines()]
    assert len(rows) == 3 + 2
    assert {(row["job"]["seed"], row["job"]["iterations"]) for row in rows[:-1]} == {(0, 3)}
    names = [name.decode() for name in kept["pareto-samples.svg"].split(b"<!-- ")]
    assert any(name.startswith("front: none is better") for name in names)
    again = bench(*arguments)
    assert again.output == told.output
    assert kept == {name: (tmp_path / "out" / name).read_bytes() for name in FILES}


def test_sets_bring_their_models(small, monkeypatch, backend, tmp_path):
    for part, count in (("train", 12), ("test", 2)):
        (tmp_path / "faces" / part).mkdir(parents=True)
        for k, image in enumerate(family(count, seed=k_seed(part))):
            eg.save_image(tmp_path / "faces" / part / f"{k}.png", image)
    tiny = sets.ImageSet("faces", 32, 32, 100)
    monkeypatch.setattr(sets, "SETS", {"faces256": tiny, "kodak": tiny._replace(folder="photos")})
    monkeypatch.setattr(pareto, "SETS", sets.SETS)
    monkeypatch.setattr(sets, "MOST_COMPONENTS", 6)
    monkeypatch.setattr(pareto, "DEFAULT_COMPONENTS", 4)
    monkeypatch.setattr(pareto, "COMPONENTS", (2, 6))
    found = pareto.collected(tmp_path, "faces256", 9, tmp_path / "models", backend)
    assert [name for name, _ in found.images] == ["0.png", "1.png"]
    assert found.basis.components == (4, 4, 4)
    assert {k: model.components for k, model in found.others.items()} == {2: (2,) * 3, 6: (6,) * 3}
    (tmp_path / "faces" / "test").rename(tmp_path / "photos")
    found = pareto.collected(tmp_path, "kodak", 1, tmp_path / "models", backend)
    assert found.basis is small_model(backend)
    assert found.others == {}
    assert len(found.images) == 1


def k_seed(part):
    return {"train": 0, "test": 1}[part]


def test_mistakes_are_told_before_the_work(small, monkeypatch, tmp_path):
    told = bench("-o", tmp_path / "out", "--set", "faces256")
    assert told.exit_code == 2
    assert told.output.count("\n") == 1
    assert "needs DATA" in told.output
    (tmp_path / "file").touch()
    assert bench("-o", tmp_path / "file").exit_code == 2
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    told = bench("-o", tmp_path / "out")
    assert told.exit_code == 2
    assert "eigengs-dr[charts]" in told.output
    assert not (tmp_path / "out").exists()


def test_the_command_knows_all_sets():
    assert tuple(sets.SETS) == cli_shared.SETS
    assert pareto.SAMPLES == cli_shared.SAMPLES
    assert "Examples" in bench("--help").output

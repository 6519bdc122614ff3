"""Hard cases, how they are scored, and the measure of tiling."""

from functools import partial

import numpy as np
import pytest

from _helpers.benchmarks import RUN, cell_row, lines_of, run, task_in
from eigengs_bench.experiments import stability
from eigengs_bench.experiments import stability_cases as cases
from eigengs_bench.experiments.stability_cases import CASES, Case, flat, heap, outside, photo
from eigengs_bench.harness.store import read
from eigengs_bench.harness.tiling import smooth_regions, tiling
from eigengs_bench.names import PRESETS as NAMES
from eigengs_bench.report.sections.stability import defects, summarize
from eigengs_dr.fitting.options import PRESETS
from eigengs_dr.gaussian.covariance import condition_number
from eigengs_dr.gaussian.gaussians import MIN_DEVIATION
from eigengs_dr.image.metrics import MAX_PSNR, psnr


def small(name="small", gaussians=20, iterations=3, **rest):
    return Case(name, partial(photo, 24, 16), gaussians, iterations, **rest)


# --- Cases ---


def test_cases_are_what_they_are_called():
    assert len(CASES) == 21
    made = {name: case.image() for name, case in CASES.items() if name != "large"}
    for name, image in made.items():
        assert image.dtype == np.float32 and image.shape[2] == 3
        assert image.min() >= 0 and image.max() <= 1
        assert CASES[name].gaussians <= image.shape[0] * image.shape[1]
    assert made["impulse"].sum() == 3
    for axis in (0, 1):
        assert (np.abs(np.diff(made["checkerboard"], axis=axis)) == 1).all()
    assert made["1x512"].shape == (1, 512, 3) and made["smooth"].shape == (512, 512, 3)
    assert len(np.unique(made["saturated"].reshape(-1, 3), axis=0)) == 8
    assert 0.05 < (1 - made["text"]).mean() < 0.4 and 0.05 < made["lines"].mean() < 0.4
    assert np.std(made["noise"] - made["photo"]) > 0.2
    assert np.abs(made["foreign"] - made["photo"]).max() > 0.5
    np.testing.assert_array_equal(made["noise"], CASES["noise"].image())


def test_hard_starts_are_what_they_are_called():
    image, generator = np.zeros((20, 40, 3), np.float32), np.random.default_rng(0)
    mean, factor = cases.needles(image, 50, generator)
    assert condition_number(factor) == pytest.approx(1e4)
    assert (1 / cases.subpixel(image, 50, generator)[1][:, 0] < MIN_DEVIATION).all()
    assert len(np.unique(heap(image, 50, generator)[0], axis=0)) == 1
    mean, factor = outside(image, 50, generator)
    assert mean.shape == (50, 2) and factor.shape == (50, 3)
    assert ((mean < 0) | (mean > [40, 20])).any(axis=1).all()


# --- Cells ---


def test_a_cell_tells_what_the_moments_say(backend):
    case = small()
    image = case.image()
    found = stability.measure_cell(case, "default", 0, backend)
    moments = stability.moments(case, image, "default", 0, backend)
    assert [moment.iteration for moment in moments] == [0, 3]
    for space in ("ycbcr", "rgb"):
        first, last = (psnr(moment.picture, image, space) for moment in moments)
        assert found[f"start_{space}"] == pytest.approx(first, abs=1e-6)
        assert found[f"end_{space}"] == pytest.approx(last, abs=1e-6)
        assert found[f"drop_{space}"] == pytest.approx(max(first, last) - last, abs=1e-6)
        assert found[f"half_{space}"] == pytest.approx(last, abs=1)
    assert found["half_ycbcr"] != found["end_ycbcr"]
    highest = max(condition_number(m.gaussians.to_arrays()["factor"]).max() for m in moments)
    assert found["condition"] == pytest.approx(highest)
    assert found["finite"] and found["gaussians"] == 20 and "peak_gib" not in found


def test_a_case_is_compared_with_a_shorter_run(backend):
    case = small(iterations=30, shorter=10)
    found = stability.measure_cell(case, "default", 0, backend)
    shorter = stability.moments(small(iterations=10), case.image(), "default", 0, backend)
    expected = psnr(shorter[-1].picture, case.image(), "ycbcr")
    assert found["shorter_ycbcr"] == pytest.approx(expected, abs=1e-6)
    [clamped] = cases.chosen_cases(["steps"], 40)
    assert (clamped.iterations, clamped.shorter) == (40, 40)


def test_exact_pictures_do_not_drop(backend):
    case = Case("constant", partial(flat, 0.2, 0.5, 0.7), 20, 3)
    found = stability.measure_cell(case, "default", 0, backend)
    assert found["start_ycbcr"] == MAX_PSNR
    assert found["drop_ycbcr"] == MAX_PSNR - found["end_ycbcr"]


def test_rates_are_multiplied(backend):
    slow, fast = (
        stability.moments(case, case.image(), "gaussianimage", 0, backend)[-1].gaussians
        for case in (small(rates=1e-9), small(rates=10.0))
    )
    placed = stability.moments(small(iterations=0), small().image(), "gaussianimage", 0, backend)
    start = placed[0].gaussians.to_arrays()["color"]
    assert np.abs(slow.to_arrays()["color"] - start).max() < 1e-6
    assert np.abs(fast.to_arrays()["color"] - start).max() > 5e-3


@pytest.mark.parametrize("preset", ["default", "eigengs"])
def test_given_shapes_are_started_from(backend, preset):
    case = small(iterations=0, place=heap)
    [start] = stability.moments(case, case.image(), preset, 0, backend)
    arrays = start.gaussians.to_arrays()
    np.testing.assert_array_equal(arrays["mean"], np.tile([12.5, 8.5], (20, 1)))
    # Solved colours of equal splats are equal, drawn ones are not, and their background is black.
    solved = PRESETS[preset].solves
    assert (np.ptp(arrays["color"], axis=0).max() < 1e-6) == solved
    assert (np.abs(arrays["background"]).max() > 0.1) == solved
    case = small(iterations=0, place=outside)
    [start] = stability.moments(case, case.image(), preset, 0, backend)
    mean = start.gaussians.to_arrays()["mean"]
    assert (mean >= 0).all() and (mean <= [24, 16]).all()  # inside their bounds


def test_what_a_preset_cannot_do_is_said():
    case = Case("thin", partial(photo, 70, 71))
    found = stability.measure_cell(case, "eigengs", 0, None)
    assert found == {"needs": "a basis with at most 4970 Gaussians"}


def test_a_set_that_is_not_finite_is_seen(backend):
    case = small()
    image = case.image()
    moments = stability.moments(case, image, "default", 0, backend)
    picture = moments[0].picture.copy()
    picture[3, 4, 1] = np.inf
    assert stability._score(moments, image)["finite"]
    assert not stability._score([moments[0]._replace(picture=picture), moments[1]], image)["finite"]
    moments[0].gaussians.color[0] = moments[0].gaussians.color[0] * np.inf
    assert not stability._score(moments, image)["finite"]


def test_a_case_alone_tells_its_memory(backend, monkeypatch, tmp_path):
    monkeypatch.setattr(stability, "peak_gib", lambda: -1.0)  # of this process
    [(name, work)] = stability.jobs(
        task_in(tmp_path, backend, seed=3), [small(alone=True)], ["default"]
    )
    assert name == {"case": "small", "preset": "default", "seed": 3, "iterations": 3}
    assert 0.02 < work()["peak_gib"] < 50


# --- The matrix ---


def test_defects_are_named():
    rows = [
        cell_row("better"),
        cell_row("rounding", end_ycbcr=29.995),
        cell_row("worse", end_ycbcr=29.5),
        cell_row("lost", finite=False, start_ycbcr=None, end_ycbcr=None),
        cell_row("plateau", shorter_ycbcr=40.3),
        cell_row("longer", shorter_ycbcr=39.0),
        cell_row("other", "eigengs", end_ycbcr=10.0),
        cell_row("thin", needs="more"),
    ]
    assert defects(rows) == [
        "worse: ends 0.50 dB below its start",
        "lost: not finite",
        "plateau: ends 0.30 dB below a run of fewer steps",
    ]
    assert lines_of(summarize(rows).tables[-1]) == [(line,) for line in defects(rows)]


def test_tables_show_presets_side_by_side():
    later = {**RUN, "commit": "b" * 40}
    rows = [
        cell_row(
            "photo", end_rgb=MAX_PSNR, half_rgb=90.0, seconds=1.0, peak_gib=2.5, drop_ycbcr=0.0
        ),
        cell_row("photo", "eigengs", finite=False),
        cell_row("other", "eigengs", condition=123456.7, run=later),
        cell_row("thin", needs="a basis"),
    ]
    rows[-1]["job"]["iterations"] = 2000
    ends, rgb, drop, half, condition, _, cost, wrong = summarize(rows).tables
    assert ends.caption.endswith(
        "; 100 or 2,000 steps [rows of different code: commit aaaaaaaaa; commit bbbbbbbbb]"
    )
    assert list(ends.frame.columns) == ["case", "default", "eigengs"]
    assert lines_of(ends) == [
        ("photo", "40.0 from 30.0", "not finite"),
        ("other", "-", "40.0 from 30.0"),
        ("thin", "needs a basis", "-"),
    ]
    first = [lines_of(table)[0][1] for table in (rgb, drop, half, cost)]
    assert first == ["exact", "0.00", "10.00", "1.0 (2.5 GiB)"]
    assert lines_of(condition)[1][2] == "1.2e+05" and wrong.frame.empty


# --- Tiling ---


def gradient(side=128):
    y, x = np.indices((side, side)) / side
    return np.stack([0.2 + 0.5 * x, 0.3 + 0.4 * y, 0.5 - 0.2 * x], axis=2)


def waves(period, side=128):
    """A lattice of grey bumps, RMS 1."""
    y, x = np.indices((side, side)) * (2 * np.pi / period)
    bumps = np.cos(x) * np.cos(y)
    return (bumps / np.sqrt(np.mean(bumps**2)))[..., None] * np.ones(3)


def test_tiles_are_told_from_slow_errors():
    image, error = gradient(), waves(8) / 255
    tiles = tiling(image + error, image)
    assert tiles == pytest.approx(1, rel=0.05)
    assert tiles > 20 * tiling(image + waves(128) / 255, image)
    assert tiling(image, image) == 0
    assert tiling(image + 3 * error, image) == pytest.approx(3 * tiles)


def test_errors_at_edges_do_not_count():
    image = gradient()
    image[:, 64:] += 0.3
    error = np.zeros_like(image)
    error[:, 62:66] = 0.1
    assert tiling(image + error, image) < 0.1
    assert tiling(gradient() + error, gradient()) > 1
    assert not smooth_regions(image)[:, 60:68].any()
    assert smooth_regions(image)[:, :30].mean() > 0.8


def test_where_nothing_is_smooth_there_is_no_figure():
    image = np.indices((32, 32)).sum(axis=0)[..., None] % 2 * np.ones(3)
    assert np.isnan(tiling(image, image))


# --- The command ---


def test_the_command_writes_rows_tables_and_tiles(monkeypatch, tmp_path):
    for name in ("smooth", "photo"):
        monkeypatch.setitem(CASES, name, small(name))
    folder = tmp_path / "made" / "here"
    arguments = ("-o", folder, "--case", "smooth", "--case", "photo", "--iterations", 2)
    told = run("bench", "stability", *arguments)
    assert told.exit_code == 0, told.output
    for word in ("smooth", "photo", *NAMES, "needs a basis with at most 384 Gaussians", "2 steps"):
        assert word in told.stdout
    assert (folder / "stability-tiles.png").stat().st_size > 10_000
    rows = read(folder / "stability.jsonl")
    jobs = [(r["job"]["case"], r["job"]["preset"], r["job"]["iterations"]) for r in rows]
    assert jobs == [(case, name, 2) for case in ("smooth", "photo") for name in NAMES]
    assert run("bench", "stability", *arguments, "--quiet").stdout == ""
    assert read(folder / "stability.jsonl") == rows  # nothing is measured twice


def test_an_unknown_case_is_refused(tmp_path):
    told = run("bench", "stability", "-o", tmp_path / "new", "--case", "nothing")
    assert told.exit_code == 2
    assert "case 'nothing' is unknown; use one of photo, constant" in told.stderr

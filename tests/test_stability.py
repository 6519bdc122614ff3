"""Hard cases of the benchmark, how they are judged, and the measure of tiling."""

from functools import partial

import click
import numpy as np
import pytest
from click.testing import CliRunner

import eigengs_dr as eg
from eigengs_dr.bench import stability, tiling
from eigengs_dr.bench.cases import CASES, Case, flat, heap, needles, outside, photo, subpixel
from eigengs_dr.bench.rows import read
from eigengs_dr.cli.console import Program
from eigengs_dr.cli_stability import NAMES
from eigengs_dr.cli_stability import stability as command
from eigengs_dr.fitting.presets import PRESETS
from eigengs_dr.gaussian.covariance import factor_from_covariance
from eigengs_dr.gaussian.gaussians import MIN_DEVIATION
from eigengs_dr.image.metrics import MAX_PSNR


@click.group(cls=Program)
def program():
    """Hold the command, as the group ``bench`` does."""


program.add_command(command)


def run(*arguments):
    return CliRunner().invoke(program, ["stability", *map(str, arguments)])


def small(name="small", gaussians=20, iterations=3, **rest):
    return Case(name, partial(photo, 24, 16), gaussians, iterations, **rest)


def row(preset="default", case="photo", **figures):
    return {
        "job": {"case": case, "preset": preset, "seed": 0, "iterations": 10},
        "finite": True,
        "start_ycbcr": 30.0,
        "end_ycbcr": 40.0,
        **figures,
    }


# --- Cases ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in CASES if name != "large"])
def test_cases_are_images_and_start_where_they_say(name):
    case = CASES[name]
    image, again = case.image(), case.image()
    assert image.dtype == np.float32 and image.shape[2] == 3
    assert image.min() >= 0 and image.max() <= 1
    assert case.gaussians <= image.shape[0] * image.shape[1]
    np.testing.assert_array_equal(image, again)


def test_hard_images_are_what_they_are_called():
    made = {name: CASES[name].image() for name in CASES if name not in ("large", "smooth")}
    assert made["impulse"].sum() == 3
    assert (np.abs(np.diff(made["checkerboard"], axis=0)) == 1).all()
    assert (np.abs(np.diff(made["checkerboard"], axis=1)) == 1).all()
    assert made["1x512"].shape == (1, 512, 3)
    assert len(np.unique(made["saturated"].reshape(-1, 3), axis=0)) == 8
    assert 0.05 < (1 - made["text"]).mean() < 0.4
    assert 0.05 < made["lines"].mean() < 0.4
    assert np.std(made["noise"] - made["photo"]) > 0.2
    assert np.abs(made["foreign"] - made["photo"]).max() > 0.5


def test_hard_starts_are_what_they_are_called():
    image, generator = np.zeros((20, 40, 3), np.float32), np.random.default_rng(0)
    mean, factor = needles(image, 50, generator)
    assert stability.condition(factor) == pytest.approx(1e4)
    assert (1 / subpixel(image, 50, generator)[1][:, 0] < MIN_DEVIATION).all()
    assert len(np.unique(heap(image, 50, generator)[0], axis=0)) == 1
    mean, factor = outside(image, 50, generator)
    assert mean.shape == (50, 2) and factor.shape == (50, 3)
    assert ((mean < 0) | (mean > [40, 20])).any(axis=1).all()


# --- Cells ---------------------------------------------------------------------------------------


def test_the_condition_is_the_ratio_of_eigenvalues():
    generator = np.random.default_rng(1)
    covariance = []
    for _ in range(20):
        root = generator.normal(size=(2, 2))
        covariance.append(root @ root.T + 0.01 * np.eye(2))
    xx, xy, yy = np.array([[s[0, 0], s[0, 1], s[1, 1]] for s in covariance]).T
    expected = max(np.linalg.cond(s) for s in covariance)
    assert stability.condition(factor_from_covariance(xx, xy, yy)) == pytest.approx(expected)
    assert stability.condition(np.array([[3.0, 0.0, 3.0]], np.float32)) == 1


def test_a_cell_tells_what_the_moments_say(backend):
    case = small()
    image = case.image()
    found = stability.measured(case, "default", 0, backend)
    moments = stability.moments(case, image, "default", 0, backend)
    assert [moment.iteration for moment in moments] == [0, 3]
    for space in ("ycbcr", "rgb"):
        first, last = (eg.psnr(moment.picture, image, space) for moment in moments)
        assert found[f"start_{space}"] == pytest.approx(first, abs=1e-6)
        assert found[f"end_{space}"] == pytest.approx(last, abs=1e-6)
        assert found[f"drop_{space}"] == pytest.approx(max(first, last) - last, abs=1e-6)
        assert found[f"half_{space}"] == pytest.approx(last, abs=1)
    assert found["half_ycbcr"] != found["end_ycbcr"]
    highest = max(stability.condition(m.gaussians.to_arrays()["factor"]) for m in moments)
    assert found["condition"] == pytest.approx(highest)
    assert found["finite"] and found["gaussians"] == 20 and "peak_gib" not in found


def test_exact_pictures_do_not_drop(backend):
    case = Case("constant", partial(flat, 0.2, 0.5, 0.7), 20, 3)
    found = stability.measured(case, "default", 0, backend)
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


@pytest.mark.parametrize("place", [outside, subpixel])
def test_given_shapes_are_brought_inside_their_bounds(backend, place):
    case = small(iterations=0, place=place)
    [start] = stability.moments(case, case.image(), "default", 0, backend)
    arrays = start.gaussians.to_arrays()
    assert (arrays["mean"] >= 0).all() and (arrays["mean"] <= [24, 16]).all()
    assert arrays["factor"].max() <= 1 / MIN_DEVIATION


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


def test_what_a_preset_cannot_do_is_said():
    case = Case("thin", partial(photo, 70, 71))
    assert stability.measured(case, "eigengs", 0, None) == {
        "needs": "a basis with at most 4970 splats"
    }


def test_a_set_that_is_not_finite_is_seen(backend):
    case = small()
    moments = stability.moments(case, case.image(), "default", 0, backend)
    picture = moments[0].picture.copy()
    picture[3, 4, 1] = np.inf
    spoiled = [moments[0]._replace(picture=picture), moments[1]]
    assert stability._judged(moments, case.image())["finite"]
    assert not stability._judged(spoiled, case.image())["finite"]
    arrays = moments[0].gaussians
    arrays.color[0] = arrays.color[0] * np.inf
    spoiled = [moments[0]._replace(gaussians=arrays), moments[1]]
    assert not stability._judged(spoiled, case.image())["finite"]


def test_a_case_alone_tells_its_memory(backend, monkeypatch):
    monkeypatch.setattr(stability, "_peak", lambda: -1.0)  # of this process
    [(name, work)] = stability.jobs([small(alone=True)], ["default"], 3, backend)
    assert name == {"case": "small", "preset": "default", "seed": 3, "iterations": 3}
    assert 0.02 < work()["peak_gib"] < 50


# --- The matrix ----------------------------------------------------------------------------------


def test_defects_are_named():
    rows = [
        row(case="better"),
        row(case="rounding", end_ycbcr=29.995),
        row(case="worse", end_ycbcr=29.5),
        row(case="lost", finite=False, start_ycbcr=None, end_ycbcr=None),
        row("eigengs", case="other", end_ycbcr=10.0),
        {"job": {"case": "thin", "preset": "default", "iterations": 10}, "needs": "more"},
    ]
    found = stability.defects(rows)
    assert found == ["worse: ends 0.50 dB below its start", "lost: not finite"]
    assert stability.defects(rows, "eigengs") == ["other: ends 20.00 dB below its start"]


def test_tables_show_presets_side_by_side():
    rows = [
        row(end_rgb=MAX_PSNR, half_rgb=90.0, seconds=1.0, peak_gib=2.5, drop_ycbcr=0.0),
        row("eigengs", finite=False),
        row("eigengs", case="other", condition=123456.7),
        {"job": {"case": "thin", "preset": "default", "iterations": 2000}, "needs": "a basis"},
    ]
    found = stability.tables(rows)
    ends, rgb, drop, half, condition, _, cost = found
    assert "10 or 2,000 steps" in ends.caption
    assert ends.columns == ("case", "default", "eigengs")
    assert ends.rows[0] == ("photo", "40.0 from 30.0", "not finite")
    assert ends.rows[1] == ("other", "-", "40.0 from 30.0")
    assert ends.rows[2] == ("thin", "needs a basis", "-")
    assert rgb.rows[0][1] == "exact"
    assert drop.rows[0][1] == "0.00"
    assert half.rows[0][1] == "10.00"
    assert condition.rows[1][2] == "1.2e+05"
    assert cost.rows[0][1] == "1.0 (2.5 GiB)"


# --- Tiling --------------------------------------------------------------------------------------


def gradient(side=128):
    y, x = np.indices((side, side)) / side
    return np.stack([0.2 + 0.5 * x, 0.3 + 0.4 * y, 0.5 - 0.2 * x], axis=2)


def waves(period, side=128):
    """A lattice of grey bumps, RMS 1."""
    y, x = np.indices((side, side)) * (2 * np.pi / period)
    bumps = np.cos(x) * np.cos(y)
    return (bumps / np.sqrt(np.mean(bumps**2)))[..., None] * np.ones(3)


def test_tiles_are_told_from_slow_errors():
    image = gradient()
    tiles = tiling.tiling(image + waves(8) / 255, image)
    slow = tiling.tiling(image + waves(128) / 255, image)
    assert tiles == pytest.approx(1, rel=0.05)
    assert tiles > 20 * slow


def test_equal_pictures_have_no_tiles_and_errors_count_linearly():
    image, error = gradient(), waves(8) / 255
    assert tiling.tiling(image, image) == 0
    once, thrice = (tiling.tiling(image + k * error, image) for k in (1, 3))
    assert thrice == pytest.approx(3 * once)


def test_errors_at_edges_do_not_count():
    image = gradient()
    image[:, 64:] += 0.3
    error = np.zeros_like(image)
    error[:, 62:66] = 0.1
    assert tiling.tiling(image + error, image) < 0.1
    assert tiling.tiling(gradient() + error, gradient()) > 1
    assert not tiling.smooth_regions(image)[:, 60:68].any()
    assert tiling.smooth_regions(image)[:, :30].mean() > 0.8


def test_where_nothing_is_smooth_there_is_no_figure():
    image = np.indices((32, 32)).sum(axis=0)[..., None] % 2 * np.ones(3)
    assert np.isnan(tiling.tiling(image, image))
    with pytest.raises(ValueError, match="differ"):
        tiling.tiling(image[:8], image)


# --- The command ---------------------------------------------------------------------------------


@pytest.fixture
def tiny(monkeypatch):
    """Cases so small that the command runs at once."""
    monkeypatch.setitem(CASES, "smooth", small("smooth"))
    monkeypatch.setitem(CASES, "photo", small("photo"))


def test_the_command_writes_rows_tables_and_tiles(tiny, tmp_path):
    pytest.importorskip("matplotlib")
    folder = tmp_path / "made" / "here"
    arguments = ("-o", folder, "--case", "smooth", "--case", "photo", "--iterations", 2)
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    for word in ("smooth", "photo", *NAMES, "needs a basis with at most 384 splats", "2 steps"):
        assert word in result.stdout
    assert (folder / "stability-tiles.png").stat().st_size > 10_000
    rows = read(folder / "stability.jsonl")
    jobs = [(r["job"]["case"], r["job"]["preset"], r["job"]["iterations"]) for r in rows]
    assert jobs == [(case, name, 2) for case in ("smooth", "photo") for name in NAMES]
    assert run(*arguments, "--quiet").stdout == ""
    assert read(folder / "stability.jsonl") == rows  # nothing is measured twice


def test_defects_are_told(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(stability, "TOLERANCE", -1000.0)
    result = run("-o", tmp_path, "--case", "photo", "--preset", "default")
    assert "defect of default: photo: ends " in result.stdout
    assert not (tmp_path / "stability-tiles.png").exists()


def test_mistakes_cost_one_line(tmp_path):
    result = run("-o", tmp_path / "new", "--case", "nothing")
    assert result.exit_code == 2
    assert "case 'nothing' is unknown; use one of photo, constant" in result.stderr
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").write_text("")
    assert run("-o", tmp_path / "file").exit_code == 2
    assert tuple(PRESETS) == NAMES
    assert "Examples:" in run("--help").stdout

"""Benchmarks on sets of images: what is measured, kept, continued and printed."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from scenes import family, small_model

from eigengs_dr import cli_tables
from eigengs_dr.bench import losses, rows, sets, summary, tables, trial
from eigengs_dr.bench.table import Table, as_text, mean, median, number, spread
from eigengs_dr.cli.main import main
from eigengs_dr.fitting.fit import fit
from eigengs_dr.fitting.initializers import initialize
from eigengs_dr.fitting.presets import PRESETS
from eigengs_dr.image.io import ImageError, save_image
from eigengs_dr.image.metrics import psnr
from eigengs_dr.raster.render import picture_of

RUN = {"command": "eigengs-dr bench tables", "cpu": "a CPU"}


@pytest.fixture
def data(tmp_path, monkeypatch):
    """Two sets of 32x32 pixels that stand for those of the paper."""
    for folder, seed in (("faces256", 0), ("natural256", 1)):
        images = family(16, seed=seed)
        for k, image in enumerate(images):
            path = tmp_path / "data" / folder / ("test" if k < 2 else "train")
            path.mkdir(parents=True, exist_ok=True)
            save_image(path / f"{k:02}.png", image)
    small = {name: sets.ImageSet(name, 32, 32, 60) for name in ("faces256", "natural256")}
    monkeypatch.setattr(sets, "SETS", {**sets.SETS, **small})
    for module in (tables, summary):
        monkeypatch.setattr(module, "SETS", sets.SETS)
    monkeypatch.setattr(sets, "MOST_COMPONENTS", 8)
    for module in (tables, summary):
        monkeypatch.setattr(module, "PAPERS_COMPONENTS", (4, 8))
    return tmp_path / "data"


def measured(data, folder, backend, names=("faces256",), iterations=12, **settings):
    settings = {"tables": tables.TABLES, "images": 2, "seed": 0, "about": RUN, **settings}
    return tables.run(data, folder, names, iterations=iterations, backend=backend, **settings)


# --- A descent under observation -----------------------------------------------------------------


@pytest.mark.parametrize("preset", ["default", "gaussianimage", "eigengs"])
def test_a_trial_sees_what_fit_sees(backend, preset):
    """At the steps of a trace, the pictures are those that `fit` judged."""
    image, model = family(1, seed=3)[0], small_model(backend)
    settings = {"init": "auto", "basis": model}
    method = PRESETS[preset]
    moments = list(
        trial.follow(
            lambda: initialize(image, 100, method=method, backend=backend, **settings),
            method.schedule,
            20,
            {0, 10, 20},
        )
    )
    trace = fit(image, 100, 20, preset=preset, backend=backend, **settings).trace
    assert [m.iteration for m in moments] == [row["iteration"] for row in trace] == [0, 10, 20]
    for moment, row in zip(moments, trace, strict=True):
        judged = trial.score(moment, image)
        assert judged["psnr_rgb"] == row["psnr_rgb"]
        assert judged["psnr_ycbcr"] == row["psnr_ycbcr"]
        assert judged["ms_ssim"] <= 1
        assert judged["iteration"] == row["iteration"]


def test_the_clock_starts_before_the_start_and_stops_for_the_observer(backend, monkeypatch):
    """Every look at the clock is a second; the observer's looks are not counted."""
    ticks = iter(range(1000))
    monkeypatch.setattr(trial.time, "perf_counter", lambda: float(next(ticks)))
    image = family(1)[0]

    def start():
        for _ in range(50):
            next(ticks)
        return initialize(image, 30, "grid", "", PRESETS["default"], backend=backend)

    seconds = []
    for moment in trial.follow(start, PRESETS["default"].schedule, 2, {0, 1, 2}):
        seconds.append(moment.seconds)
        for _ in range(100):
            next(ticks)
    assert seconds[0] == 51
    assert seconds[2] - seconds[0] == 2


# --- Results that can be continued ---------------------------------------------------------------


def jobs(counts, names=("a", "b", "c")):
    def work(name):
        counts.append(name)
        return {"value": np.float32(1.5), "worst": np.inf}

    return [({"image": name, "seed": 0}, lambda name=name: work(name)) for name in names]


def test_what_is_measured_is_not_measured_again(tmp_path):
    path, counts, seen = tmp_path / "r.jsonl", [], []
    rows.measure(path, jobs(counts, "ab"), RUN)
    found = rows.measure(path, jobs(counts), RUN, lambda *done: seen.append(done))
    assert counts == ["a", "b", "c"]
    assert [row["job"]["image"] for row in found] == ["a", "b", "c"]
    assert found == rows.read(path)
    assert found[0]["value"] == 1.5 and found[0]["worst"] is None
    assert found[0]["run"]["command"] == RUN["command"] and "UTC" in found[0]["run"]["date"]
    assert seen[0] == (0, 3) and seen[-1] == (3, 3)


def test_a_line_that_was_cut_short_is_measured_again(tmp_path):
    path, counts = tmp_path / "r.jsonl", []
    rows.measure(path, jobs(counts, "ab"), RUN)
    path.write_bytes(path.read_bytes()[:-20])
    assert len(rows.read(path)) == 1
    found = rows.measure(path, jobs(counts, "ab"), RUN)
    assert counts == ["a", "b", "b"]
    assert rows.read(path) == found
    assert path.read_text().count("\n") == 2


def test_what_was_measured_before_an_interrupt_is_kept(tmp_path):
    path, counts = tmp_path / "r.jsonl", []

    def stop():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rows.measure(path, [*jobs(counts, "a"), ({"image": "b"}, stop)], RUN)
    assert [row["job"]["image"] for row in rows.read(path)] == ["a"]


def test_results_of_two_machines_do_not_mix(tmp_path):
    path = tmp_path / "r.jsonl"
    rows.measure(path, jobs([], "a"), RUN)
    rows.measure(path, jobs([], "a"), {**RUN, "command": "another"})
    with pytest.raises(ValueError, match=r"r\.jsonl: was measured on another machine.*\(a CPU\)"):
        rows.measure(path, jobs([], "a"), {**RUN, "cpu": "another"})


@pytest.mark.parametrize("line", ["{", "[]", "{}", '{"job": 1, "run": {}}', "\xff"])
def test_a_damaged_line_is_named(tmp_path, line):
    path = tmp_path / "r.jsonl"
    path.write_text(line + "\n")
    with pytest.raises(ValueError, match=r"r\.jsonl: line 1 is not a measurement"):
        rows.read(path)


# --- Sets and their models -----------------------------------------------------------------------


def test_the_first_images_are_cropped_to_the_size_of_a_set(tmp_path, monkeypatch):
    monkeypatch.setitem(sets.SETS, "kodak", sets.ImageSet("photos", 30, 20, 50))
    (tmp_path / "photos").mkdir()
    for name, shape in (("b", (40, 20, 3)), ("a", (40, 60, 3)), ("c", (9, 9, 3))):
        save_image(tmp_path / "photos" / f"{name}.png", np.full(shape, 0.5))
    found = sets.test_images(tmp_path, "kodak", 2)
    assert [(name, image.shape) for name, image in found] == [
        ("a.png", (20, 30, 3)),
        ("b.png", (30, 20, 3)),
    ]
    with pytest.raises(ImageError, match="cars256"):
        sets.test_images(tmp_path, "cars256", 2)


def test_models_are_trained_once_on_the_training_images(data, tmp_path, backend, monkeypatch):
    arguments = (data, "faces256", "natural256", 4, tmp_path / "models", "rgb", True)
    model = sets.model_for(*arguments, backend=backend)
    assert model.components == (4, 4, 4)
    assert len(model.gaussians) == 60 and model.low == 6
    assert model.gaussians.space == "rgb"
    expected = family(16, seed=1)[2:].mean(axis=(0, 1, 2))
    assert np.allclose(model.mean_image.mean(axis=(1, 2)), expected, atol=5e-3)
    monkeypatch.setattr(sets.Eigenbasis, "from_images", None)
    sets.model_for(*arguments, backend=backend)
    sets.model_for(*arguments[:6], backend=backend)  # another model of the same basis


# --- The tables ----------------------------------------------------------------------------------


def test_every_method_is_measured_on_every_image(data, tmp_path, backend):
    found = measured(data, tmp_path, backend)
    fits = [row for row in found if "moments" in row]
    names = [row["job"] for row in fits]
    assert len(fits) == 2 * (2 + 4 + 4)
    assert [job["image"] for job in names[:10]] == ["00.png"] * 10  # methods take turns
    assert all(job["seed"] == 0 and job["gaussians"] == 60 for job in names)
    assert {(j["source"], j["components"]) for j in names if j["preset"] == "eigengs"} == {
        ("faces256", 4),
        ("faces256", 8),
        ("natural256", 4),
        ("natural256", 8),
    }
    for row in fits:
        assert [m["iteration"] for m in row["moments"]] == [0, 10, 12]
        assert row["moments"][0]["seconds"] < row["moments"][2]["seconds"]
    before = (tmp_path / "tables.jsonl").read_bytes()
    assert measured(data, tmp_path, backend) == found
    assert (tmp_path / "tables.jsonl").read_bytes() == before


def test_figures_are_those_of_the_named_method(data, tmp_path, backend):
    """The first image of the test folder, by `fit` itself."""
    found = measured(data, tmp_path, backend, images=1)
    image = sets.test_images(data, "faces256", 1)[0][1]
    model = sets.model_for(data, "faces256", "faces256", 8, tmp_path / "models", backend=backend)
    ends = {
        (row["job"]["preset"], row["job"]["components"], row["job"]["color"]): row["moments"][-1]
        for row in found
        if "moments" in row and row["job"]["source"] in ("", "faces256")
    }
    for preset, components in (("default", 0), ("gaussianimage", 0), ("eigengs", 8)):
        result = fit(
            image,
            None if components else 60,
            12,
            preset=preset,
            basis=model,
            backend=backend,
        )
        expected = result.trace[-1]
        assert ends[preset, components, "ycbcr"]["psnr_ycbcr"] == expected["psnr_ycbcr"]
        assert ends[preset, components, "ycbcr"]["psnr_rgb"] == expected["psnr_rgb"]
    assert ends["eigengs", 4, "rgb"]["psnr_rgb"] != ends["eigengs", 4, "ycbcr"]["psnr_rgb"]


def test_default_reaches_what_gaussianimage_has(data, tmp_path, backend):
    found = measured(data, tmp_path, backend, images=1, tables=["reach"])
    [goal] = [r["moments"][-1] for r in found if r["job"].get("preset") == "gaussianimage"]
    [reached] = [row for row in found if "share" in row]
    assert reached["solve_steps"] == 1 and reached["iteration"] == 0
    assert reached["psnr_ycbcr"] >= goal["psnr_ycbcr"]
    assert reached["share"] == reached["seconds"] / goal["seconds"]


def test_a_goal_above_the_start_is_reached_by_descent(backend):
    image = family(1)[0]

    def start(depth):
        return initialize(image, 60, "grid", "", PRESETS["default"], depth, backend=backend)

    reached = psnr(picture_of(start(10).gaussians), image, "ycbcr")
    goal = {"psnr_ycbcr": reached + 3, "seconds": 2.0}
    found = tables._reach(start, image, goal)
    assert found["solve_steps"] == 10 and found["iteration"] > 0
    assert found["psnr_ycbcr"] >= goal["psnr_ycbcr"]
    goal["psnr_ycbcr"] = 200.0
    assert tables._reach(start, image, goal) == {"share": None}


@pytest.mark.parametrize(("iterations", "anew"), [(1000, [10]), (3, [])])
def test_programs_are_compiled_for_splats_placed_anew_where_a_run_places_them(
    backend, iterations, anew
):
    placed = initialize(
        family(1, seed=3)[0], 10, "auto", "natural", PRESETS["default"], backend=backend
    )
    counts = []

    def rearrange(gaussians, count):
        counts.append(count)
        return gaussians

    def start():
        return placed._replace(redistribute=rearrange)

    trial.warm_up(start, PRESETS["default"].schedule, iterations)
    assert counts == anew


def moment(iteration, value, **others):
    rgb = None if value is None else value - 6
    figures = {"psnr_ycbcr": value, "psnr_rgb": rgb, "ssim": 0.5, "ms_ssim": 0.75}
    return {"iteration": iteration, "seconds": 1.0, **figures, **others}


def row(image, moments, name="faces256", iterations=1000, **method):
    job = {"set": name, "image": image, "iterations": iterations, "seed": 0, "gaussians": 60}
    return {"job": {**job, **tables.Method("default")._asdict(), **method}, "moments": moments}


def test_cells_are_means_over_images():
    found = [
        row(str(k), [moment(0, 30.0 + 2 * k), moment(1000, value)], preset=preset)
        for preset in ("default", "gaussianimage")
        for k, value in enumerate((34.0, 36.0, None, 42.0))
    ]
    [glance, table, printed] = summary.tables(found)
    assert glance.rows == [
        ("faces256", preset, "4", "33.0", "-", "-", "-", "37.3 (1 failed)", "1.00 (1.00-1.00)")
        for preset in ("gaussianimage", "default")
    ]
    assert table.columns == ("method", "figure", "0", "1,000")
    cells = {line[:2]: line[2:] for line in table.rows}
    assert cells["default", "PSNR YCbCr / dB"] == ("33.0 ± 2.6", "37.3 ± 4.2 (1 failed)")
    assert cells["default", "% above 35 dB YCbCr"] == ("25", "50")
    assert cells["default", "% above 40 dB YCbCr"] == ("0", "25")
    assert cells["gaussianimage", "seconds"] == ("1.00 (1.00-1.00)",) * 2
    assert "4 images" in table.caption and "1,000 steps" in table.caption
    assert printed.caption.startswith("What the paper prints")
    assert ("CelebA, 256x256", "GaussianImage", "-", "10.3", "21.9", "30.0") in printed.rows


def test_the_ablation_shows_both_spaces():
    variants = [(color, split) for color in ("ycbcr", "rgb") for split in ("split", "whole")]
    found = [
        row(
            "a",
            [moment(1000, 40.0)],
            preset="eigengs",
            source="faces256",
            components=300,
            color=color,
            split=split,
        )
        for color, split in variants
    ]
    table = next(t for t in summary.tables(found) if t.caption.startswith("Colour space"))
    assert table.rows[0] == ("faces256", "split", "ycbcr", "40.0", "34.0", "0.750", "40.0")
    assert table.rows[3] == ("faces256", "whole", "rgb", "40.0", "34.0", "0.750", "34.0")
    assert not any("Colour space" in t.caption for t in summary.tables(found[:3]))


def test_what_is_never_reached_is_said():
    found = [
        {"job": {"set": "faces256", "iterations": 1000}, "share": share, "seconds": 0.04}
        for share in (0.02, 0.01, 0.04, None)
    ]
    [table] = summary.tables(found)
    assert table.rows == [
        ("faces256", "1,000", "3 of 4", "0.040 (0.040-0.040)", "0.0200 (0.0150-0.0300)", "0.0400")
    ]


# --- Where default loses -------------------------------------------------------------------------


def cell(case, preset, end):
    return {"job": {"case": case, "preset": preset, "iterations": 100, "seed": 0}, "end_ycbcr": end}


def test_losses_after_as_many_steps_and_after_as_much_time():
    """The other starts sooner, is ahead after 10 steps, and is overtaken."""
    ours = [(0, 2.0, 30.0), (10, 3.0, 34.0), (100, 9.0, 45.0)]
    theirs = [(0, 1.0, 25.0), (10, 2.5, 36.0), (100, 8.0, 40.0)]
    fits = [
        row(image, [moment(i, p, seconds=t) for i, t, p in moments], preset=preset, iterations=100)
        for image in "ab"
        for preset, moments in (("default", ours), ("gaussianimage", theirs))
    ]
    found = losses.table(fits, []).rows
    where = "faces256, 100 steps"
    assert list(found) == [
        (where, "until 2.000 s", "gaussianimage", "25.0", "-"),
        (where, "10 steps", "gaussianimage", "36.0", "34.0"),
        (where, "2.500 s", "gaussianimage", "36.0", "30.0"),
        (where, "8.000 s", "gaussianimage", "40.0", "34.0"),
    ]
    assert not losses.table(fits[:-1], []).rows  # not the same images
    assert not losses.table(fits[1:], []).rows


def test_a_fit_that_has_failed_is_behind():
    fits = [
        row("a", [moment(100, value)], preset=preset, iterations=100)
        for preset, value in (("default", None), ("gaussianimage", 9.0), ("eigengs", None))
    ]
    found = losses.table(fits, []).rows
    assert [line[2:] for line in found] == [("gaussianimage", "9.0", "failed")] * 2
    early = [moment(0, None, seconds=0.5), moment(100, None)]
    assert not losses.table([fits[0], row("a", early, preset="eigengs", iterations=100)], []).rows
    cells = [cell("noise", "default", None), cell("noise", "eigengs", 9.0)]
    assert [line[2] for line in losses.table([], cells).rows] == ["eigengs"]


def test_losses_in_hard_cases():
    cells = [
        cell("black", "default", 50.0),
        cell("black", "eigengs", 50.0),
        cell("noise", "default", 20.0),
        cell("noise", "eigengs", 21.5),
        cell("lines", "default", 20.0),
        {"job": cell("lines", "eigengs", 0)["job"], "needs": "a basis"},
        cell("smooth", "eigengs", 60.0),
    ]
    assert list(losses.table([], cells).rows) == [
        ("case noise", "100 steps", "eigengs", "21.5", "20.0")
    ]


def test_cells():
    assert number(None) == number(float("nan")) == "-"
    assert number(12345.678, 2) == "12,345.68"
    assert number(float("inf")) == "inf"
    assert spread([1.0, 3.0, None, float("inf")], 2) == "2.00 ± 1.41 (2 failed)"
    assert spread([1.0, None]) == mean([1.0, None]) == "1.0 (1 failed)"
    assert spread([None]) == "- (1 failed)" and mean([1.0, 2.0]) == "1.5"
    assert spread([1.0]) == "1.0" and spread([]) == "-"
    assert median([1.0, 2.0, 3.0, 4.0, 5.0]) == "3.00 (2.00-4.00)"
    assert median([1.0], 3) == "1.000" and median([]) == "-"
    table = Table("A caption", ("name", "dB"), [("one", "1.0"), ("eleven", "11.0")])
    assert as_text(table).split("\n") == [
        "A caption",
        "",
        "name      dB",
        "------------",
        "one      1.0",
        "eleven  11.0",
    ]


# --- The command ---------------------------------------------------------------------------------


def test_the_command_prints_tables_and_goes_on(data, tmp_path, backend):
    output = tmp_path / "results"
    arguments = ["bench", "tables", str(data), "-o", str(output), "--backend", backend]
    arguments += ["--set", "faces256", "--table", "main", "--images", "1", "--iterations", "3"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0
    assert "Methods: faces256, 1 image of 32x32, 60 Gaussians, 3 steps" in result.stdout
    assert "eigengs, 8 components, universal basis" in result.stdout
    lines = (output / "tables.jsonl").read_text().splitlines()
    assert len(lines) == 6
    told = json.loads(lines[0])["run"]
    assert told["command"].startswith("eigengs-dr bench tables") and told["backend"] == backend
    result = CliRunner().invoke(main, [*arguments, "--quiet"])
    assert result.exit_code == 0 and not result.stdout
    assert (output / "tables.jsonl").read_text().splitlines() == lines


def test_the_command_knows_the_tables_and_the_papers_sets():
    assert cli_tables.TABLES == tables.TABLES
    assert "kodak" not in cli_tables.PAPERS and len(cli_tables.PAPERS) == len(sets.SETS) - 1


def test_a_set_that_is_named_twice_is_measured_once(data, tmp_path, backend):
    arguments = ["bench", "tables", str(data), "-o", str(tmp_path / "r"), "--backend", backend]
    arguments += ["--table", "main", "--images", "1", "--iterations", "2"]
    result = CliRunner().invoke(main, [*arguments, *["--set", "faces256"] * 2])
    assert "Methods: faces256, 1 image of 32x32" in result.stdout


def test_a_set_that_is_not_there_is_named(tmp_path):
    (tmp_path / "data").mkdir()
    arguments = ["bench", "tables", str(tmp_path / "data"), "-o", str(tmp_path / "results")]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 2
    assert "faces256: not a readable folder" in result.stderr

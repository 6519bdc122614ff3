"""The paper's tables: what is measured, how it is told, and where default loses."""

import json

import pytest

from _helpers.benchmarks import (
    RUN,
    cell_row,
    fit_row,
    lines_of,
    make_sets,
    moment,
    one_image,
    run,
    task_in,
)
from eigengs_bench.experiments import tables
from eigengs_bench.harness.datasets import images_of, model_for
from eigengs_bench.report.sections import methods
from eigengs_bench.report.sections.losses import where_default_loses
from eigengs_dr.fitting.fit import fit
from eigengs_dr.fitting.options import PRESETS, FitOptions
from eigengs_dr.fitting.start import initialize
from eigengs_dr.image.metrics import psnr
from eigengs_dr.raster.render import picture_of


@pytest.fixture
def data(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "COMPONENTS", (4, 8))
    return make_sets(tmp_path / "data", monkeypatch)


def test_every_method_is_measured_and_figures_are_those_of_fit(data, tmp_path, backend):
    task = task_in(tmp_path, backend, data, images=1, iterations=12)
    found = tables.run(task, ["faces256"])
    fits = [row for row in found if "moments" in row]
    jobs = [row["job"] for row in fits]
    assert len(fits) == 2 + 4 + 4
    bases = {(j["source"], j["components"]) for j in jobs if j["preset"] == "eigengs"}
    assert bases == {(source, k) for source in ("faces256", "natural256") for k in (4, 8)}
    ends = {
        (j["preset"], j["source"], j["components"], j["space"], j["split"]): row["moments"]
        for j, row in zip(jobs, fits, strict=True)
    }
    (image,) = [image for _, image in images_of(task, "faces256")]
    model = model_for(task, "faces256", "faces256", 8)
    for preset in PRESETS:
        own = ("faces256", 8) if preset == "eigengs" else ("", 0)
        moments = ends[(preset, *own, "ycbcr", "auto")]
        assert [m["iteration"] for m in moments] == [0, 10, 12]
        assert moments[0]["seconds"] < moments[2]["seconds"]
        count = None if preset == "eigengs" else 60
        start = model if preset == "eigengs" else None
        last = fit(image, count, 12, preset=preset, start=start, backend=backend).trace[-1]
        assert moments[-1]["psnr_ycbcr"] == last["psnr_ycbcr"]
        assert moments[-1]["psnr_rgb"] == last["psnr_rgb"]
    rgb, ycbcr = (ends["eigengs", "faces256", 4, c, "whole"][-1] for c in ("rgb", "ycbcr"))
    assert rgb["psnr_rgb"] != ycbcr["psnr_rgb"]
    [reached] = [row for row in found if "share" in row]
    goal = ends["gaussianimage", "", 0, "ycbcr", "auto"][-1]
    assert reached["solve_steps"] == 1 and reached["iteration"] == 0
    assert reached["psnr_ycbcr"] >= goal["psnr_ycbcr"]
    assert reached["share"] == reached["seconds"] / goal["seconds"]
    before = (tmp_path / tables.FILE).read_bytes()
    assert tables.run(task, ["faces256"]) == found
    assert (tmp_path / tables.FILE).read_bytes() == before
    captions = " / ".join(table.caption for table in methods.summarize(found).tables)
    for start in ("PSNR YCbCr", "Methods: faces256, 1 image of 32x32", "Bases", "Colour", "Time"):
        assert start in captions


def test_a_goal_above_the_start_is_reached_by_descent(backend):
    image = one_image(0)

    def start(depth):
        options = FitOptions(gaussians=60, init="grid", solve_steps=depth, backend=backend)
        return initialize(image, options)

    reached = psnr(picture_of(start(10).gaussians), image, "ycbcr")
    goal = {"psnr_ycbcr": reached + 3, "seconds": 2.0}
    found = tables._reach(start, image, goal)
    assert found["solve_steps"] == 10 and found["iteration"] > 0
    assert found["psnr_ycbcr"] >= goal["psnr_ycbcr"]
    goal["psnr_ycbcr"] = 200.0
    assert tables._reach(start, image, goal) == {"share": None}


# --- How it is told ---


def four_images(run=RUN):
    return [
        fit_row(str(k), [moment(0, 30.0 + 2 * k), moment(1000, value)], preset, run)
        for preset in ("default", "gaussianimage")
        for k, value in enumerate((34.0, 36.0, None, 42.0))
    ]


def test_cells_are_means_over_images():
    glance, shown, printed = methods.summarize(four_images()).tables
    assert lines_of(glance) == [
        ("faces256", preset, "4", "33.0", "37.3 (1 failed)", "1.00 (1.00-1.00)")
        for preset in ("gaussianimage", "default")
    ]
    assert list(shown.frame.columns) == ["method", "figure", "0", "1,000"]
    cells = {line[:2]: line[2:] for line in lines_of(shown)}
    assert cells["default", "PSNR YCbCr / dB"] == ("33.0 ± 2.6", "37.3 ± 4.2 (1 failed)")
    assert cells["default", "% above 35 dB YCbCr"] == ("25", "50")
    assert cells["default", "% above 40 dB YCbCr"] == ("0", "25")
    assert cells["gaussianimage", "seconds"] == ("1.00 (1.00-1.00)",) * 2
    assert cells["gaussianimage", "MS-SSIM"] == ("0.750 ± 0.000",) * 2
    assert "4 images" in shown.caption and "1,000 steps" in shown.caption
    assert printed.caption.startswith("What the paper prints")
    assert lines_of(printed)[0][1:5] == ("GaussianImage", "-", "10.3", "21.9")


def test_the_ablation_shows_both_spaces():
    kinds = [(color, split) for color in ("ycbcr", "rgb") for split in ("split", "whole")]
    method = {"preset": "eigengs", "source": "faces256", "components": 300}
    rows = [fit_row("a", [moment(1000, 40.0)], **method, space=c, split=s) for c, s in kinds]
    ablation, printed = methods.summarize(rows).tables
    assert ablation.caption.startswith("Colour space and split: faces256")
    assert lines_of(ablation)[0] == ("eigengs, ycbcr, split", "PSNR YCbCr / dB", "40.0")
    assert lines_of(ablation)[-2] == ("eigengs, rgb, whole", "PSNR RGB / dB", "34.0")
    assert lines_of(printed)[0][:3] == ("ycbcr", "split", "47.2")


def test_labels_tell_whose_basis_it_is():
    method = tables.Method("eigengs", "natural256", 300)
    assert methods.label(method, "natural256") == "eigengs, 300 components, own basis"
    assert methods.label(method, "cats256") == "eigengs, 300 components, universal basis"
    assert "faces256 basis" in methods.label(method._replace(source="faces256"), "cats256")


def test_what_is_never_reached_is_said():
    job = {"set": "faces256", "iterations": 1000}
    rows = [
        {"job": job, "share": share, "seconds": 0.04, "run": RUN}
        for share in (0.02, 0.01, 0.04, None)
    ]
    [table] = methods.summarize(rows).tables
    assert lines_of(table) == [
        ("faces256", "1,000", "3 of 4", "0.040 (0.040-0.040)", "0.0200 (0.0150-0.0300)", "0.0400")
    ]


# --- Where default loses ---


def losses(fits, cells=()):
    (table,) = where_default_loses(fits, cells).tables
    return lines_of(table)


def test_losses_after_as_many_steps_and_after_as_much_time():
    """The other starts sooner, is ahead after 10 steps, and is overtaken."""
    ours = [(0, 2.0, 30.0), (10, 3.0, 34.0), (100, 9.0, 45.0)]
    theirs = [(0, 1.0, 25.0), (10, 2.5, 36.0), (100, 8.0, 40.0)]
    fits = [
        fit_row(image, [moment(i, p, t) for i, t, p in moments], preset, iterations=100)
        for image in "ab"
        for preset, moments in (("default", ours), ("gaussianimage", theirs))
    ]
    where = "faces256, 100 steps"
    assert losses(fits) == [
        (where, "until 2.000 s", "gaussianimage", "25.0", "-"),
        (where, "10 steps", "gaussianimage", "36.0", "34.0"),
        (where, "2.500 s", "gaussianimage", "36.0", "30.0"),
        (where, "8.000 s", "gaussianimage", "40.0", "34.0"),
    ]
    assert not losses(fits[:-1])  # not the same images
    assert not losses(fits[1:])


def test_a_fit_that_has_failed_is_behind_all_others():
    fits = [
        fit_row("a", [moment(100, value)], preset, iterations=100)
        for preset, value in (("default", None), ("gaussianimage", 9.0))
    ]
    assert [line[2:] for line in losses(fits)] == [("gaussianimage", "9.0", "failed")] * 2
    cells = [cell_row("noise", end_ycbcr=None), cell_row("noise", "eigengs", end_ycbcr=9.0)]
    assert losses([], cells) == [("case noise", "100 steps", "eigengs", "9.0", "failed")]


def test_losses_in_hard_cases():
    cells = [
        cell_row("black", end_ycbcr=50.0),
        cell_row("black", "eigengs", end_ycbcr=50.0),
        cell_row("noise", end_ycbcr=20.0),
        cell_row("noise", "eigengs", end_ycbcr=21.5),
        cell_row("lines", end_ycbcr=20.0),
        cell_row("lines", "eigengs", needs="a basis"),
        cell_row("smooth", "eigengs", end_ycbcr=60.0),
    ]
    assert losses([], cells) == [("case noise", "100 steps", "eigengs", "21.5", "20.0")]
    assert losses([], cells[5:6]) == []


# --- The command ---


def test_the_command_prints_tables_and_goes_on(data, tmp_path, backend):
    output = tmp_path / "results"
    arguments = ["bench", "tables", data, "-o", output, "--backend", backend, "--set", "faces256"]
    arguments += ["--set", "faces256", "--table", "main", "--images", 1, "--iterations", 3]
    told = run(*arguments)
    assert told.exit_code == 0, told.output
    assert "Methods: faces256, 1 image of 32x32, 60 Gaussians, 3 steps" in told.stdout
    assert "eigengs, 8 components, universal basis" in told.stdout
    lines = (output / "tables.jsonl").read_text().splitlines()
    assert len(lines) == 6
    made = json.loads(lines[0])["run"]
    assert made["command"].startswith("eigengs-dr bench tables") and made["backend"] == backend
    assert {"commit", "clean"} <= set(made)
    again = run(*arguments, "--quiet")
    assert again.exit_code == 0 and not again.output
    assert (output / "tables.jsonl").read_text().splitlines() == lines
    older = [json.loads(line) for line in lines]
    for row in older:
        row["run"]["commit"] = "c" * 40
    (output / "tables.jsonl").write_text("".join(json.dumps(row) + "\n" for row in older))
    told = run(*arguments)
    assert told.stderr.count("\n") == 1 and "rows of other code" in told.stderr
    assert "commit ccccccccc" in told.stderr

"""The Kodak photos beside published figures: rows, the table, the charts, and the command."""

import json

import numpy as np
import pytest

from _helpers.benchmarks import RUN, broken_off, lines_of, one_image, run, task_in
from eigengs_bench.experiments import kodak
from eigengs_bench.names import SETS, ImageSet
from eigengs_bench.report.sections.kodak import published, summarize
from eigengs_dr.fitting.fit import fit
from eigengs_dr.image.io import save_image
from eigengs_dr.image.metrics import psnr


@pytest.fixture
def data(tmp_path, monkeypatch):
    """A folder with two photos, one of them a portrait."""
    monkeypatch.setitem(SETS, "kodak", ImageSet("kodak", 32, 24, 40))
    monkeypatch.setattr(kodak, "WARM_UP", 1)
    (tmp_path / "kodak").mkdir()
    save_image(tmp_path / "kodak" / "a.png", one_image()[:24])
    save_image(tmp_path / "kodak" / "b.png", one_image(6)[:, :24])
    return tmp_path


def test_a_fit_is_measured_in_the_metric_of_the_field(backend):
    image, task = 0.999 * one_image(), task_in("unused", backend)
    found = kodak._measure(task, image, 40, 20, 3)
    expected = fit(image, 40, 20, space="rgb", solve_steps=3, backend=backend)
    error = np.clip(expected.image, 0, 1).astype(np.float64) - image
    assert found["psnr_float"] == pytest.approx(-10 * np.log10(np.mean(error**2)), abs=1e-6)
    assert found["psnr_rgb"] == pytest.approx(psnr(expected.image, image), abs=1e-6)
    assert found["taken"] == 20 and found["seconds"] > 0 and 0 < found["ms_ssim"] <= 1


def test_an_interrupted_run_goes_on(backend, data, monkeypatch):
    task = task_in(data, backend, data)
    monkeypatch.setattr(kodak, "fit", broken_off)
    with pytest.raises(KeyboardInterrupt):
        kodak.run(task, (10, 20), (2,), 10, False)
    monkeypatch.undo()
    monkeypatch.setitem(SETS, "kodak", ImageSet("kodak", 32, 24, 40))
    rows = kodak.run(task, (10, 20), (2, 3), 10, False)
    jobs = [(j["iterations"], j["image"], j["gaussians"]) for j in (row["job"] for row in rows)]
    assert jobs == [(k, name, n) for k in (2, 3) for name in ("a.png", "b.png") for n in (10, 20)]
    monkeypatch.setattr(kodak, "fit", broken_off)
    assert kodak.run(task, (20,), (3,), 10, False) == [rows[5], rows[7]]


def row(image, count, decibels, timed=False, seconds=1.0, steps=1000, depth=10):
    job = {"image": image, "gaussians": count, "iterations": steps, "timed": timed}
    job["solve_steps"] = depth
    figures = {"psnr_float": decibels, "psnr_rgb": decibels - 0.1, "ms_ssim": 0.9}
    return {"job": job, **figures, "seconds": seconds, "run": RUN}


def test_the_table_shows_ours_beside_published_figures():
    rows = [row("a", 5000, 32.0, True, 9.0), row("a", 5000, 32.0), row("b", 5000, 33.0)]
    section = summarize([*rows, row("a", 70_000, 48.0, seconds=99.0)])
    lines = lines_of(section.tables[0])
    ours = [line for line in lines if line[1] == "default"]
    assert ours[0][2:8] == ("1,000", "32.50", "32.40", "0.9000", "9.0", "2")
    assert ours[1][:4] == ("70,000", "default", "1,000", "48.00") and ours[1][6] == "-"
    assert ("5,000", "GaussianImage", "50,000", "29.85") in [line[:4] for line in lines]
    assert len(lines) == 2 + len(published())
    assert [int(line[0].replace(",", "")) for line in lines] == sorted(
        int(line[0].replace(",", "")) for line in lines
    )


def test_fits_without_steps_are_told_apart_by_their_solves():
    few, many = (row("a", 28_000, d, True, s, 0, k) for d, s, k in ((30, 0.2, 10), (31, 0.8, 30)))
    section = summarize([few, many, row("a", 28_000, 40.0)])
    ours = [line[1:7] for line in lines_of(section.tables[0]) if line[1].startswith("default")]
    assert ours == [
        ("default", "0", "30.00", "29.90", "0.9000", "0.2"),
        ("default, solve_steps=30", "0", "31.00", "30.90", "0.9000", "0.8"),
        ("default", "1,000", "40.00", "39.90", "0.9000", "-"),
    ]
    labels = section.charts["kodak-seconds"][1].axes[0].get_legend_handles_labels()[1]
    assert {"default, 0 steps", "default, solve_steps=30, 0 steps"} <= set(labels)


def test_charts_show_means_and_the_seconds_of_timed_fits():
    rows = [row("a", 5000, 32.0), row("b", 5000, 33.0), row("a", 10_000, 36.0)]
    assert set(summarize(rows).charts) == {"kodak-gaussians"}
    charts = summarize([*rows, row("a", 5000, 32.0, True, 9.0)]).charts
    curves = {
        name: {line.get_label(): line.get_xydata() for line in figure.axes[0].lines}
        for name, (_, figure) in charts.items()
    }
    ours = curves["kodak-gaussians"]["default, 1,000 steps"]
    np.testing.assert_allclose(ours, [[5000, 32.5], [10_000, 36.0]])
    assert set(published().method) < set(curves["kodak-gaussians"])
    np.testing.assert_allclose(curves["kodak-seconds"]["default, 1,000 steps"], [[9.0, 32.0]])
    assert "GaussianImage, on NVIDIA V100" in curves["kodak-seconds"]


def test_every_published_figure_has_a_source():
    known = published()
    assert known.source.notna().all() and (known.psnr_float > 25).all()
    assert known.machine.notna().equals(known.seconds.notna())


def test_the_command_fits_draws_and_goes_on(backend, data, tmp_path):
    out = tmp_path / "out"
    arguments = ("kodak", data, "-o", out, "--counts", 12, "--photos", 1, "--backend", backend)
    told = run("bench", *arguments, "--steps", 2, "--steps", 3, "--timed")
    assert told.exit_code == 0, told.output
    for text in ("measured", "arXiv 2403.08551", "kodak-gaussians.svg", "kodak-seconds.svg"):
        assert text in told.stdout
    kept = (out / "kodak.jsonl").read_bytes()
    rows = [json.loads(line) for line in kept.splitlines()]
    assert [r["job"]["iterations"] for r in rows] == [2, 3]
    assert run("bench", *arguments, "--steps", 3, "--steps", 2, "--timed").exit_code == 0
    assert (out / "kodak.jsonl").read_bytes() == kept
    told = run("bench", "report", out, "-o", tmp_path / "page")
    assert told.exit_code == 0, told.output
    assert "published figures" in (tmp_path / "page" / "index.html").read_text()

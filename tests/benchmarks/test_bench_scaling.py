"""What size costs: the images, the cases, the clocks, and the tables and charts of rows."""

import json

import numpy as np
import pytest

from _helpers.benchmarks import RUN, lines_of, run, task_in
from eigengs_bench.experiments import scaling
from eigengs_bench.experiments.scaling import CELL, Case, mosaic
from eigengs_bench.harness.alone import measure_alone, peak_gib
from eigengs_bench.harness.store import read
from eigengs_bench.names import PARTS
from eigengs_bench.report.page import write_page
from eigengs_bench.report.sections.scaling import slope, summarize


def row(part, side, gaussians, threads=0, **figures):
    job = {"part": part, "width": side, "height": side, "gaussians": gaussians}
    usual = {"place_seconds": 0.5, "solve_seconds": 0.25, "step_ms": 1.0, "ns_a_pixel": 10.0}
    usual |= {"mean_ms": 2.0, "peak_gib": 0.125}
    return {"job": {**job, "threads": threads, "iterations": 24}, **usual, **figures, "run": RUN}


def small_cases(monkeypatch):
    monkeypatch.setattr(scaling, "SIDES", (16, 32, 4096))
    monkeypatch.setattr(scaling, "SPLATS", {(24, 16): (10, 20)})
    monkeypatch.setattr(scaling, "THREADED", (16,))
    monkeypatch.setattr(scaling, "SMALL", {16: 10})
    monkeypatch.setattr(scaling, "FIT_SECONDS", 1e-9)


def end(*arguments):
    """Stand for work that memory ends."""
    import os

    os._exit(9)


def test_a_mosaic_has_other_photos_side_by_side():
    image = mosaic(2 * CELL, CELL + 8)
    assert image.shape == (CELL + 8, 2 * CELL, 3) and image.dtype == np.float32
    assert image.min() >= -0.1 and image.max() <= 1.1 and image.std() > 0.1
    assert np.abs(image[:CELL, :CELL] - image[:CELL, CELL:]).mean() > 0.1
    np.testing.assert_array_equal(mosaic(40, 24), image[:24, :40])


def test_cases_grow_and_small_images_take_more_steps(backend, monkeypatch, tmp_path):
    task = task_in(tmp_path, backend, iterations=24)
    named = [name for name, _ in scaling.jobs(task, PARTS, 4096)]
    assert max(name["width"] for name in named) == 4096
    pixels = [name for name in named if name["part"] == "pixels"]
    assert (pixels[1]["gaussians"], pixels[1]["iterations"]) == (5000, 96)
    assert pixels[-1]["iterations"] == 24
    assert max(n["gaussians"] for n in named) == 2_000_000
    assert [n["gaussians"] for n in named if n["part"] == "small"] == [300, 1245, 5000]
    assert {n["threads"] for n in named if n["part"] == "threads"} >= {1}
    monkeypatch.setattr(scaling.dr, "thread_count", lambda: 12)
    counts = [case.threads for case in scaling.cases("threads", backend) if case.width == 256]
    assert counts == [1, 2, 4, 8, 12]


def test_a_mean_counts_what_single_steps_count(backend, monkeypatch):
    """Clocks see a step that takes longer, and take the start for none."""

    clock = 0.0

    def slow(problem, schedule, iterations):
        nonlocal clock
        yield "start"
        for _ in range(iterations):
            clock += 0.01
            yield "set"

    monkeypatch.setattr(scaling.time, "perf_counter", lambda: clock)
    monkeypatch.setattr(scaling, "descend", slow)
    median, mean = scaling.time_steps(None, 3)
    assert (median, mean) == (pytest.approx(10), pytest.approx(10))


def test_a_descent_and_fits_are_measured(backend):
    found = scaling.measure_descent(Case(24, 16, 20), 3, backend)
    assert all(value > 0 for value in found.values())
    assert found["ns_a_pixel"] == pytest.approx(found["mean_ms"] * 1e6 / (24 * 16))
    assert 0.02 < found["peak_gib"] < 50


def test_memory_is_that_of_a_process_alone():
    held = np.ones(1 << 26)  # 512 MiB
    here, there = peak_gib(), measure_alone("alone", peak_gib)
    assert here > 0.5 > there > 0.005 and held.all()
    with pytest.raises(ValueError, match="a case: its process was ended"):
        measure_alone("a case", end)


def test_slopes_are_exponents():
    assert slope([1, 10, 100], [3, 300, 30000]) == pytest.approx(2)
    assert slope([10, 20, 30], [5, 5, 5]) == pytest.approx(0)
    assert np.isnan(slope([10], [5])) and np.isnan(slope([10, 10], [5, 6]))


def test_tables_and_charts_show_each_part(tmp_path):
    rows = [row("pixels", n, n, mean_ms=n**2 / 100, peak_gib=n / 800) for n in (200, 100)]
    rows += [row("splats", 100, n, mean_ms=n**0.5) for n in (100, 10_000)]
    rows += [row("threads", 64, 9, n, mean_ms=8 / n) for n in (1, 2)]
    rows.append({**row("small", 64, 300), "images_per_second": 15.04})
    pixels, splats, threads, small = summarize(rows).tables
    assert "exponent 1.00 of the pixels, memory by 4,474 bytes a pixel" in pixels.caption
    assert "100x100 0.50" in splats.caption and "fits of 24 steps" in small.caption
    first = ("100x100", "100", "1.00", "100.00", "10.0", "0.50", "0.25", "0.12")
    assert lines_of(pixels)[0] == first
    assert [line[2:] for line in lines_of(threads)] == [
        ("1", "1.00", "8.00", "1.00"),
        ("2", "1.00", "4.00", "2.00"),
    ]
    assert lines_of(small) == [("64x64", "300", "15.0", "0.12")]
    (tmp_path / scaling.FILE).write_text("".join(json.dumps(line) + "\n" for line in rows))
    write_page(tmp_path, tmp_path / "page")
    drawn = {path.name for path in (tmp_path / "page" / "pictures").iterdir()}
    assert drawn == {f"scaling-{name}.svg" for name in ("pixels", "splats", "threads")}
    assert "## What size costs" in (tmp_path / "page" / "README.md").read_text()


def test_the_command_measures_each_size_once(monkeypatch, tmp_path):
    small_cases(monkeypatch)
    monkeypatch.setattr(scaling, "measure_alone", lambda title, work, *rest: work(*rest))
    monkeypatch.setattr(scaling.dr, "thread_count", lambda: 1)
    monkeypatch.setattr(scaling.dr, "set_thread_count", lambda count: None)
    monkeypatch.setattr(scaling, "FIT_STEPS", 2)
    arguments = ("bench", "scaling", "-o", tmp_path, "--max-side", 32, "--iterations", 3)
    told = run(*arguments)
    assert told.exit_code == 0, told.output
    rows = read(tmp_path / scaling.FILE)
    assert [r["job"]["width"] for r in rows] == [16, 32, 24, 24, 16, 16]
    assert {r["job"]["part"] for r in rows} == set(PARTS)
    assert run(*arguments, "--quiet").stdout == ""
    assert read(tmp_path / scaling.FILE) == rows
    assert (tmp_path / "scaling-pixels.svg").exists()

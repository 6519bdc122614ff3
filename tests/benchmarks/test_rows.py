"""Rows: kept, continued, of which code they are, and what a table and the report say of it."""

import subprocess
import sys

import numpy as np
import pytest

from _helpers.benchmarks import RUN, row, task_in
from _helpers.command import assert_refused, run, succeeded
from eigengs_bench import report as fr
from eigengs_bench import rows

OTHER = {**RUN, "commit": "b" * 40}
DIRTY = {**RUN, "clean": False}


def jobs(done, names="abc"):
    def work(name):
        done.append(name)
        return {"value": np.float32(1.5), "worst": np.inf}

    return [({"image": name}, lambda name=name: work(name)) for name in names]


def test_what_is_measured_is_not_measured_again(tmp_path):
    done, seen = [], []
    task = task_in(tmp_path, progress=lambda *step: seen.append(step))
    task.measure("it", jobs(done, "ab"))
    found = task.measure("it", jobs(done))
    assert done == ["a", "b", "c"] and seen[-1] == ("it", 3, 3)
    assert [row["job"]["image"] for row in found] == ["a", "b", "c"]
    assert found == rows.read(tmp_path / rows.FILE) and rows.read(tmp_path / rows.FILE, "x") == []
    assert found[0]["value"] == 1.5 and found[0]["worst"] is None
    assert found[0]["run"]["commit"] == RUN["commit"] and "UTC" in found[0]["run"]["date"]
    task.measure("another", jobs(done, "a"))
    assert done[-1] == "a"


def test_rows_for_the_manual_replace_those_of_their_names(tmp_path):
    path, task = tmp_path / "manual.jsonl", task_in(tmp_path)
    rows.record(path, task.measure("it", jobs([], "ab")))
    other = [row({"image": "a"}, OTHER, value=1.23456789) | {"bench": "it"}]
    rows.record(path, other)
    first, second = rows.read(path)
    assert (first["value"], second["value"]) == (1.2346, 1.5)
    assert first["run"]["commit"] == OTHER["commit"]
    assert first["run"]["versions"] == {"eigengs_dr": "0.1.0"}


def test_a_line_that_was_cut_short_is_measured_again(tmp_path):
    path, done, task = tmp_path / rows.FILE, [], task_in(tmp_path)
    task.measure("it", jobs(done, "ab"))
    path.write_bytes(path.read_bytes()[:-20])
    assert len(rows.read(path)) == 1
    assert task.measure("it", jobs(done, "ab")) == rows.read(path)
    assert done == ["a", "b", "b"]


def test_rows_of_two_machines_do_not_mix(tmp_path):
    task = task_in(tmp_path)
    task.measure("it", jobs([], "a"))
    task._replace(run={**OTHER, "command": "another"}).measure("it", jobs([], "a"))
    with pytest.raises(ValueError, match=r"rows\.jsonl: was measured on another machine.*\(a CPU"):
        task._replace(run={**RUN, "cpu": "another"}).measure("it", jobs([], "a"))


@pytest.mark.parametrize("line", ["{", "[]", "{}", '{"bench": "a", "job": 1, "run": {}}', "\xff"])
def test_a_damaged_line_is_named(tmp_path, line):
    (tmp_path / rows.FILE).write_text(line + "\n", "latin-1")
    with pytest.raises(ValueError, match=r"rows\.jsonl: line 1 is not a measurement"):
        rows.read(tmp_path / rows.FILE)


def test_a_table_says_when_its_rows_are_of_different_code():
    said = {
        "": [RUN, RUN],
        " [rows of different code: commit aaaaaaaaa; commit bbbbbbbbb]": [RUN, OTHER, RUN],
        " [rows of code that is in no commit: commit aaaaaaaaa with uncommitted changes]": [DIRTY],
    }
    for text, runs in said.items():
        codes = fr.frame_of([row({}, run) for run in runs]).code
        assert fr.table("It", ("a",), [("1",)], codes).caption == "It" + text
    assert rows.code_name({**RUN, "commit": None}) == "version 0.1.0, commit unknown"


def git(folder, *arguments):
    identity = ["-c", "user.name=n", "-c", "user.email=e"]
    subprocess.run(["git", "-C", folder, *identity, *arguments], check=True, capture_output=True)


def test_the_commit_is_that_of_the_package(tmp_path):
    package = tmp_path / "eigengs_dr"
    package.mkdir()
    (package / "__init__.py").touch()
    assert rows.code_state(package) == {"commit": None, "clean": None}  # no git
    git(tmp_path, "init")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "one")
    state = rows.code_state(package)
    assert len(state["commit"]) == 40 and state["clean"] is True
    (package / "__init__.py").write_text("1")
    assert rows.code_state(package) == {"commit": state["commit"], "clean": False}


def test_memory_is_that_of_a_process_alone():
    assert 0.02 < rows.alone("it", rows.peak_gib)() < rows.peak_gib() + 1
    with pytest.raises(ValueError, match="it: its process was ended"):
        rows.alone("it", sys.modules["os"]._exit, 9)()


def test_the_report_has_what_rows_answer(tmp_path):
    report = ("bench", "report", tmp_path, "-o", tmp_path / "out")
    assert_refused(run(*report), "holds no rows")
    job = {"image": "a", "gaussians": 5000, "iterations": 1000, "timed": True}
    figures = {"psnr_float": 33.0, "psnr_rgb": 32.9, "ms_ssim": 0.9, "seconds": 9.0}
    task_in(tmp_path).measure("kodak", [(job, lambda: figures)])
    succeeded(run(*report))
    text = (tmp_path / "out" / "README.md").read_text()
    assert "| 5,000" in text and "33.00" in text and "GaussianImage" in text
    assert "commit aaaaaaaaa" in text and "a CPU" in text
    assert (tmp_path / "out" / "kodak-gaussians.svg").read_bytes()[:5] == b"<?xml"


def test_mistakes_are_told_before_the_work(tmp_path):
    (tmp_path / "file").touch()
    for command in ("pareto", "rate", "number", "stability", "pictures", "tables"):
        assert_refused(run("bench", command, "-o", tmp_path / "file"), "File exists")
    output = ["-o", tmp_path / "out"]
    assert_refused(run("bench", "pareto", *output, "--set", "kodak"), "needs DATA")
    said = "case 'nothing' is unknown; use one of photo, constant"
    assert_refused(run("bench", "stability", *output, "--case", "nothing"), said)

"""Rows: kept, continued, of which code they are, and what a table and the report say of it."""

import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

from _helpers.benchmarks import RUN, moment, row, run, task_in
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


def test_what_was_measured_before_an_interrupt_is_kept(tmp_path):
    def stop():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        task_in(tmp_path).measure("it", [*jobs([], "a"), ({"image": "b"}, stop)])
    assert [row["job"]["image"] for row in rows.read(tmp_path / rows.FILE)] == ["a"]


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


def test_the_commit_is_that_of_the_package(tmp_path, monkeypatch):
    package = tmp_path / "eigengs_dr"
    package.mkdir()
    (package / "__init__.py").touch()
    spec = type("Spec", (), {"origin": str(package / "__init__.py")})
    monkeypatch.setattr(rows, "find_spec", lambda name: spec)
    assert rows.code_state() == {"commit": None, "clean": None}  # no git
    git(tmp_path, "init")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "one")
    state = rows.code_state()
    assert len(state["commit"]) == 40 and state["clean"] is True
    (package / "__init__.py").write_text("1")
    assert rows.code_state() == {"commit": state["commit"], "clean": False}


def test_memory_is_that_of_a_process_alone():
    assert 0.02 < rows.alone("it", rows.peak_gib)() < rows.peak_gib() + 1
    with pytest.raises(ValueError, match="it: its process was ended"):
        rows.alone("it", sys.modules["os"]._exit, 9)()


def test_cells():
    assert fr.number(None) == fr.number(float("nan")) == "-"
    assert fr.number(12345.678, 2) == "12,345.68" and fr.number(float("inf")) == "inf"
    assert fr.mean(pd.Series([1.0, 3.0, None]), 2) == "2.00 (1 failed)"
    assert fr.median(pd.Series([1.0, 2.0, 9.0])) == "2.00"
    assert fr.extent(pd.Series([12.0, 37.0, 55.0]), 0) == "12 to 55"
    assert (fr.counted(pd.Series([1, 1])), fr.counted(pd.Series([1, 2]))) == ("1 image", "2 images")
    shown = fr.table("It", ("name", "dB"), [("one", "1.00"), ("eleven", "11.50")])
    assert fr.as_text(shown).split("\n")[2] == "name       dB"
    assert fr.as_text(fr.table("It", ("name",), [])) == "It: none"
    assert fr.smallest({100: 30.0, 400: 34.0}, 32.0) == pytest.approx(200)
    assert np.isnan(fr.smallest({100: 30.0, 400: 34.0}, 35.0))


def test_lists_in_rows_become_lines():
    made = [row({"image": "a"}, moments=[moment(0, 30.0), moment(9, None)]), row({})]
    frame = fr.frame_of(made, "moments")
    assert list(frame.iteration) == [0, 9] and set(frame.image) == {"a"}
    assert frame.psnr_ycbcr.isna().tolist() == [False, True]


def test_the_report_has_what_rows_answer(tmp_path):
    told = run("bench", "report", tmp_path, "-o", tmp_path / "out")
    assert told.exit_code == 2 and "holds no rows" in told.stderr
    job = {"image": "a", "gaussians": 5000, "iterations": 1000, "timed": True}
    figures = {"psnr_float": 33.0, "psnr_rgb": 32.9, "ms_ssim": 0.9, "seconds": 9.0}
    task_in(tmp_path).measure("kodak", [(job, lambda: figures)])
    assert run("bench", "report", tmp_path, "-o", tmp_path / "out").exit_code == 0
    text = (tmp_path / "out" / "README.md").read_text()
    assert "| 5,000" in text and "33.00" in text and "GaussianImage" in text
    assert "commit aaaaaaaaa" in text and "a CPU" in text
    assert (tmp_path / "out" / "kodak-gaussians.svg").read_bytes()[:5] == b"<?xml"


def test_help_loads_nothing_slow():
    code = """
import sys
from eigengs_dr.cli.main import main
try:
    main(["bench", "--help"])
except SystemExit:
    print([m for m in ("pandas", "matplotlib", "drjit") if m in sys.modules])
"""
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.splitlines()[-1] == "[]" and "stability" in told.stdout


def test_what_to_install_is_said_where_the_benchmarks_are_missing(monkeypatch):
    monkeypatch.setattr("eigengs_dr.cli.main.entry_points", lambda **names: [])
    for arguments in (["bench"], ["bench", "kernels"]):
        told = run(*arguments)
        assert told.exit_code == 2
        assert told.stderr.count("\n") == 1 and "pip install ./benchmarks" in told.stderr
    assert run("--help").exit_code == 0


def test_mistakes_are_told_before_the_work(tmp_path):
    (tmp_path / "file").touch()
    for command in ("pareto", "rate", "number", "stability", "pictures", "tables"):
        told = run("bench", command, "-o", tmp_path / "file")
        assert told.exit_code == 2 and "is a file" in told.stderr
    told = run("bench", "pareto", "-o", tmp_path / "out", "--set", "kodak")
    assert told.exit_code == 2 and "needs DATA" in told.stderr
    told = run("bench", "stability", "-o", tmp_path / "out", "--case", "nothing")
    assert "case 'nothing' is unknown; use one of photo, constant" in told.stderr

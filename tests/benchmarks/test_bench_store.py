"""Rows: kept, continued, of which code they are, and what a table says of it."""

import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

from _helpers.benchmarks import RUN, fit_row, moment, run
from eigengs_bench.harness import store
from eigengs_bench.report.frames import (
    as_text,
    counted,
    extent,
    frame_of,
    number,
    quartiles,
    remark,
    spread,
    table,
)

OTHER = {**RUN, "commit": "b" * 40}
DIRTY = {**RUN, "clean": False}


def jobs(done, names="abc"):
    def work(name):
        done.append(name)
        return {"value": np.float32(1.5), "worst": np.inf}

    return [({"image": name, "seed": 0}, lambda name=name: work(name)) for name in names]


def test_what_is_measured_is_not_measured_again(tmp_path):
    path, done, seen = tmp_path / "r.jsonl", [], []
    store.measure(path, jobs(done, "ab"), RUN)
    found = store.measure(path, jobs(done), RUN, lambda *step: seen.append(step))
    assert done == ["a", "b", "c"]
    assert [row["job"]["image"] for row in found] == ["a", "b", "c"]
    assert found == store.read(path)
    assert found[0]["value"] == 1.5 and found[0]["worst"] is None
    assert found[0]["run"]["commit"] == RUN["commit"] and "UTC" in found[0]["run"]["date"]
    assert seen == [(0, 3), (1, 3), (2, 3), (3, 3)]


def test_a_line_that_was_cut_short_is_measured_again(tmp_path):
    path, done = tmp_path / "r.jsonl", []
    store.measure(path, jobs(done, "ab"), RUN)
    path.write_bytes(path.read_bytes()[:-20])
    assert len(store.read(path)) == 1
    found = store.measure(path, jobs(done, "ab"), RUN)
    assert done == ["a", "b", "b"]
    assert store.read(path) == found


def test_what_was_measured_before_an_interrupt_is_kept(tmp_path):
    def stop():
        raise KeyboardInterrupt

    path = tmp_path / "r.jsonl"
    with pytest.raises(KeyboardInterrupt):
        store.measure(path, [*jobs([], "a"), ({"image": "b"}, stop)], RUN)
    assert [row["job"]["image"] for row in store.read(path)] == ["a"]


def test_rows_of_two_machines_do_not_mix(tmp_path):
    path = tmp_path / "r.jsonl"
    store.measure(path, jobs([], "a"), RUN)
    store.measure(path, jobs([], "a"), {**OTHER, "command": "another"})
    with pytest.raises(ValueError, match=r"r\.jsonl: was measured on another machine.*\(a CPU\)"):
        store.measure(path, jobs([], "a"), {**RUN, "cpu": "another"})


@pytest.mark.parametrize("line", ["{", "[]", "{}", '{"job": 1, "run": {}}', "\xff"])
def test_a_damaged_line_is_named(tmp_path, line):
    (tmp_path / "r.jsonl").write_text(line + "\n", "latin-1")
    with pytest.raises(ValueError, match=r"r\.jsonl: line 1 is not a measurement"):
        store.read(tmp_path / "r.jsonl")


# --- Of which code ---


def test_other_code_is_said_when_a_file_is_continued(tmp_path):
    path = tmp_path / "r.jsonl"
    assert store.other_code(path, RUN) == ""
    store.measure(path, jobs([], "ab"), RUN)
    assert store.other_code(path, RUN) == ""
    said = store.other_code(path, OTHER)
    assert "commit aaaaaaaaa (2); now it is commit bbbbbbbbb" in said and "\n" not in said
    assert "commit bbbbbbbbb with uncommitted" in store.other_code(path, {**OTHER, "clean": False})


def test_a_table_says_when_its_rows_are_of_different_code():
    said = {
        "": [RUN, RUN],
        " [rows of different code: commit aaaaaaaaa; commit bbbbbbbbb]": [RUN, OTHER, RUN],
        " [rows of code that is in no commit: commit aaaaaaaaa with uncommitted changes]": [DIRTY],
    }
    for text, runs in said.items():
        codes = frame_of([{"job": {}, "run": run} for run in runs]).code
        assert table("It", ("a",), [("1",)], codes).caption == "It" + text
    assert "version 0.1.0, commit unknown" in remark(
        [store.code_name({**RUN, "commit": None}), store.code_name(RUN)]
    )


def git(folder, *arguments):
    identity = ["-c", "user.name=n", "-c", "user.email=e"]
    subprocess.run(["git", "-C", folder, *identity, *arguments], check=True, capture_output=True)


def test_the_commit_is_that_of_the_package(tmp_path, monkeypatch):
    package = tmp_path / "eigengs_dr"
    package.mkdir()
    (package / "__init__.py").touch()
    spec = type("Spec", (), {"origin": str(package / "__init__.py")})
    monkeypatch.setattr(store, "find_spec", lambda name: spec)
    assert store.code_state() == {"commit": None, "clean": None}  # no git
    git(tmp_path, "init")
    git(tmp_path, "commit", "--allow-empty", "-m", "one")
    assert store.code_state() == {"commit": None, "clean": None}  # not of this tree
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "two")
    state = store.code_state()
    assert len(state["commit"]) == 40 and state["clean"] is True
    (package / "__init__.py").write_text("1")
    assert store.code_state() == {"commit": state["commit"], "clean": False}


# --- Cells ---


def test_cells():
    assert number(None) == number(float("nan")) == "-"
    assert number(12345.678, 2) == "12,345.68" and number(float("inf")) == "inf"
    assert spread(pd.Series([1.0, 3.0, None, None]), 2) == "2.00 ± 1.41 (2 failed)"
    assert spread(pd.Series([1.0, None])) == "1.0 (1 failed)"
    assert spread(pd.Series([None], dtype=float)) == "- (1 failed)"
    assert spread(pd.Series([1.0])) == "1.0"
    assert quartiles(pd.Series([1.0, 2.0, 3.0, 4.0, 5.0])) == "3.00 (2.00-4.00)"
    assert quartiles(pd.Series([1.0]), 3) == "1.000"
    assert extent(pd.Series([12.0, 37.0, 55.0]), 0) == "12 to 55"
    assert extent(pd.Series([], dtype=float), 0) == "-"
    assert (counted(pd.Series([1, 1])), counted(pd.Series([1, 2]))) == ("1 image", "2 images")
    shown = table("It", ("name", "dB"), [("one", "1.00"), ("eleven", "11.50")])
    assert as_text(shown).split("\n")[2:] == [
        "name       dB",
        "------  -----",
        "one      1.00",
        "eleven  11.50",
    ]
    assert as_text(table("It", ("name",), [])) == "It: none"


def test_lists_in_rows_become_lines():
    rows = [fit_row("a", [moment(0, 30.0), moment(9, None)]), {"job": {}, "run": RUN}]
    frame = frame_of(rows, "moments")
    assert list(frame.iteration) == [0, 9] and set(frame.image) == {"a"}
    assert frame.psnr_ycbcr.isna().tolist() == [False, True]
    assert set(frame.code) == {"commit aaaaaaaaa"}
    assert frame_of([], "moments").empty


# --- The command ---


def test_help_loads_nothing_slow_and_lists_the_commands():
    code = """
import sys
from eigengs_dr.cli.main import main
try:
    main(["--help"])
except SystemExit:
    print([m for m in ("pandas", "matplotlib", "eigengs_bench") if m in sys.modules])
"""
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.splitlines()[-1] == "[]" and "bench " in told.stdout
    listed = run("bench", "--help")
    assert listed.exit_code == 0 and "stability" in listed.stdout


def test_what_to_install_is_said_where_the_benchmarks_are_missing(monkeypatch):
    monkeypatch.setattr("eigengs_dr.cli.main.entry_points", lambda **names: [])
    for arguments in (["bench"], ["bench", "kernels"], ["bench", "--help"]):
        told = run(*arguments)
        assert told.exit_code == 2
        assert told.stderr.count("\n") == 1 and "pip install ./benchmarks" in told.stderr
    assert run("--help").exit_code == 0


@pytest.mark.parametrize(
    "command",
    ["pareto", "rate", "budget", "levels", "stability", "figures", "tables .", "report ."],
)
def test_mistakes_are_told_before_the_work(tmp_path, command):
    (tmp_path / "file").touch()
    told = run("bench", *command.split(), "-o", tmp_path / "file")
    assert told.exit_code == 2 and "is a file" in told.stderr
    assert told.stderr.count("\n") == 1
    assert run("bench", command.split()[0], "--help").exit_code == 0


def test_sets_need_data(tmp_path):
    for command in ("pareto", "rate", "budget"):
        told = run("bench", command, "-o", tmp_path / "out", "--set", "kodak")
        assert told.exit_code == 2 and "needs DATA" in told.stderr
    for wrong in ("0", "101", "nan"):
        assert run("bench", "budget", "-o", tmp_path / "x", "--target", wrong).exit_code == 2
    assert not (tmp_path / "out").exists()

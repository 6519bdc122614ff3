"""Rows of benchmarks, of which code they are, and the images that are measured."""

import subprocess

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.benchmarks import RUN, data, row, task_in  # noqa: F401  data is a fixture
from eigengs_bench import images, report, rows
from eigengs_bench.names import SETS, ImageSet

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


def test_sources_name_every_command_and_its_code():
    runs = [RUN, OTHER, DIRTY, {**RUN, "commit": None}]
    lines = report.sources_of([row({}, run) for run in runs])
    codes = [
        "commit aaaaaaaaa",
        "commit bbbbbbbbb",
        "commit aaaaaaaaa with uncommitted changes",
        "version 0.1.0, commit unknown",
    ]
    assert lines == [
        *(f"`eigengs-dr bench tables`, 2026-01-01, {code}" for code in codes),
        "a CPU, 2 threads, backend llvm; eigengs_dr 0.1.0",
    ]


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


def test_images_are_the_first_ones_at_the_size_of_their_set(tmp_path, monkeypatch):
    monkeypatch.setitem(SETS, "kodak", ImageSet("photos", 30, 20, 50))
    (tmp_path / "photos").mkdir()
    for name, shape in (("b", (40, 20, 3)), ("a", (40, 60, 3)), ("c", (9, 9, 3))):
        eg.save_image(tmp_path / "photos" / f"{name}.png", np.full(shape, 0.5))
    task = task_in(tmp_path, data=tmp_path, images=2)
    shapes = {name: image.shape for name, image in images.images_of(task, "kodak")}
    assert shapes == {"a.png": (20, 30, 3), "b.png": (30, 20, 3)}
    assert [name for name, _ in images.images_of(task, "samples", 1)] == ["chelsea"]
    with pytest.raises(eg.ImageError, match="cars256"):
        images.images_of(task, "cars256")

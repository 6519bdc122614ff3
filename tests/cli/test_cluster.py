"""The option --cluster."""

import json
import subprocess
import sys
import time

import pytest

import eigengs_dr as eg
from _helpers.clusters import files_of, folder_of_photos
from _helpers.command import assert_refused, run, succeeded
from _helpers.families import small_model
from eigengs_dr.backend.executor import ClusterError
from eigengs_dr.collection import fit_many as module

QUICK = ("--gaussians", 20, "--iterations", 2)


@pytest.fixture
def photos(tmp_path):
    return folder_of_photos(tmp_path / "photos", 4)


def test_processes_of_this_machine(photos, tmp_path):
    pytest.importorskip("distributed")
    (photos / "02.png").write_text("no image")
    report = tmp_path / "r.json"
    command = ["fit", photos, *QUICK, "--report", report]
    result = run(*command, "-o", tmp_path / "far", "--cluster", "local:1")
    assert result.exit_code == 2 and result.stderr.count("\n") == 1 and "02.png" in result.stderr
    assert "3 images fitted, 1 failed" in result.stdout
    rows = json.loads(report.read_text())["images"]
    assert [row["stopped"] for row in rows] == ["iterations", "iterations", "failed", "iterations"]
    assert rows[0]["psnr_rgb"] > 10 and rows[0]["iterations"] == 2
    run(*command, "-o", tmp_path / "here")
    assert files_of(tmp_path / "far") == files_of(tmp_path / "here")


def test_patterns(photos, tmp_path):
    succeeded(run("fit", f"{photos}/0[13].png", "-o", tmp_path / "fits", *QUICK))
    assert list(files_of(tmp_path / "fits")) == ["01.npz", "03.npz"]
    assert_refused(run("fit", f"{photos}/*.jpg", "-o", tmp_path / "x", *QUICK), "no file has such")


def test_urls(photos, tmp_path):
    pytest.importorskip("fsspec")
    succeeded(run("fit", f"file://{photos}/*.png", "-o", tmp_path / "fits", *QUICK))
    assert len(files_of(tmp_path / "fits")) == 4


def test_results_are_not_written_to_urls(photos, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = "memory://fits: results cannot be written to URLs; write to a folder"
    assert_refused(run("fit", photos, "-o", "memory://fits", *QUICK), said)
    for write in (eg.fit_many, small_model("llvm").encode_many):
        with pytest.raises(OSError, match="memory://fits: results cannot be written to URLs"):
            write(photos, "memory://fits")
    with pytest.raises(OSError, match=r"s3://bucket/x\.npz: results cannot be written to URLs"):
        small_model("llvm").save("s3://bucket/x.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


@pytest.mark.slow
def test_sigterm_ends_the_run_and_its_workers(tmp_path):
    """As schedulers of batch jobs send it; the same command then does the rest."""
    psutil = pytest.importorskip("psutil")
    pytest.importorskip("distributed")
    photos, output = folder_of_photos(tmp_path / "photos", 30, 96, 64), tmp_path / "fits"
    command = [sys.executable, "-m", "eigengs_dr", "fit", str(photos), "-o", str(output)]
    command += ["--gaussians", "300", "--iterations", "100", "--quiet", "--cluster", "local:2"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 120
        while not list(output.glob("[!.]*.npz")) and time.monotonic() < deadline:
            time.sleep(0.01)
        workers = psutil.Process(process.pid).children(recursive=True)
        process.terminate()
        _, said = process.communicate(timeout=60)
    assert process.returncode == 130 and len(workers) >= 2
    assert said.count("\n") == 1 and "interrupted" in said and "fits the others" in said
    assert not psutil.wait_procs(workers, timeout=10)[1]
    partial = files_of(output)  # reads each: all are whole
    assert 0 < len(partial) < 30
    assert not [path for path in output.glob(".*") if path.suffix != ".npz"]
    succeeded(run(*command[3:7], "--iterations", 100, "--gaussians", 300))
    assert partial.items() <= files_of(output).items() and len(files_of(output)) == 30


@pytest.mark.slow
def test_sigterm_while_workers_start(tmp_path):
    psutil = pytest.importorskip("psutil")
    pytest.importorskip("distributed")
    photos = folder_of_photos(tmp_path / "photos", 4)
    command = [sys.executable, "-m", "eigengs_dr", "fit", str(photos), "-o", str(tmp_path / "fits")]
    with subprocess.Popen(
        [*command, "--cluster", "local:2"], stderr=subprocess.PIPE, text=True
    ) as process:
        deadline = time.monotonic() + 120
        children = []
        while not children and time.monotonic() < deadline:
            children = psutil.Process(process.pid).children(recursive=True)
            time.sleep(0.01)
        process.terminate()
        _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert said.strip() == "eigengs-dr: interrupted"
    assert not psutil.wait_procs(children, timeout=10)[1]


def test_without_dask_one_line_says_what_to_install(photos, tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "eigengs_dr.cluster.executor", raising=False)
    monkeypatch.setitem(sys.modules, "distributed", None)
    result = run("fit", photos, "-o", tmp_path / "fits", *QUICK, "--cluster", "local")
    assert_refused(result, "distributed", "pip install 'eigengs-dr[cluster]'")


@pytest.mark.parametrize(
    ("cluster", "said"),
    [("nowhere", "is unknown; use"), ("local:0", "is unknown"), ("tcp://127.0.0.1:1", "start")],
)  # fmt: skip
def test_clusters_that_are_none(photos, tmp_path, cluster, said, monkeypatch):
    connect = pytest.importorskip("eigengs_dr.cluster.executor")
    monkeypatch.setattr(connect, "CONNECT_SECONDS", 0.3)
    assert_refused(run("fit", photos, "-o", tmp_path / "x", *QUICK, "--cluster", cluster), said)


def test_what_it_is_not_for(photos, tmp_path):
    output = ["-o", tmp_path / "x.npz", *QUICK, "--cluster", "local"]
    assert_refused(run("fit", photos / "00.png", *output), "--cluster takes several images")
    output = ["-o", tmp_path / "x", "--preview", tmp_path / "p", "--cluster", "local"]
    assert_refused(run("fit", photos, *output), "no --preview")


def test_a_cluster_that_is_lost(photos, tmp_path, monkeypatch):
    def lost(*arguments):
        raise ClusterError("the scheduler tcp://node:8786 is gone; start it")

    monkeypatch.setattr(module, "run_images", lost)
    assert_refused(run("fit", photos, "-o", tmp_path / "x", *QUICK), "tcp://node:8786 is gone")
    assert issubclass(eg.ClusterError, RuntimeError)

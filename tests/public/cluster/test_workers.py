"""Workers that end, that are refused, and what of a cluster is left as it is."""

import os
import re
import resource
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import dask
import drjit as dr
import numpy as np
import pytest
from distributed import Client, LocalCluster

import eigengs_dr as eg
from _helpers import clusters
from _helpers.clusters import QUICK, Deadly, FirstCall, files_of

# --- Workers that end ---


def test_a_worker_that_is_killed(client, photos, output, expected):
    """It loses what it does, which another worker does again."""
    killed = []

    def kill(done, total, row):
        if not killed:
            killed.append(next(iter(client.run(os.getpid).values())))
            os.kill(killed[0], signal.SIGKILL)

    rows = eg.fit_many(photos, output, client=client, progress=kill, **QUICK)
    assert killed and [row.status for row in rows] == ["done"] * 12
    assert files_of(output) == expected
    assert not list(output.glob(".*"))


def test_an_image_that_ends_its_worker(client, photos, output, expected):
    """It fails alone; the same call fits it when the cause is gone."""
    deadly = replace(eg.DEFAULT, place=FirstCall(clusters.die))
    rows = eg.fit_many([photos / "05.png"], output, client=client, method=deadly, **QUICK)
    assert rows[0].error.startswith(f"{photos / '05.png'}: its worker ended 2 times")
    client.wait_for_workers(2, timeout=60)
    rows = eg.fit_many(photos, output, client=client, **QUICK)
    assert {row.status for row in rows} == {"done"} and files_of(output) == expected
    with pytest.raises(eg.ClusterError, match="cannot be done: its worker ended 2 times"):
        eg.Eigenbasis.from_images([np.zeros((5, 6, 3)).view(Deadly)], (6, 5), 2, client=client)


def test_a_full_disk_is_tried_again(client, photos, output, tmp_path):
    full = replace(eg.DEFAULT, place=FirstCall(clusters.fill_disk, tmp_path / "tried"))
    try:
        [row] = eg.fit_many([photos / "00.png"], output, client=client, method=full, **QUICK)
    finally:
        client.run(resource.setrlimit, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
    assert (tmp_path / "tried").exists() and row.status == "done"
    assert [path.name for path in output.iterdir()] == ["00.npz"]


def test_ctrl_c_leaves_what_is_done(client, photos, output, expected):
    def press(done, total, row):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(eg.Interrupted) as stopped:
        eg.fit_many(photos, output, client=client, progress=press, **QUICK)
    assert len(stopped.value.result) == 3
    rows = eg.fit_many(photos, output, client=client, **QUICK)
    kept = {row.name for row in rows if row.status == "skipped"}
    assert kept >= {row.name for row in stopped.value.result}
    assert files_of(output) == expected


@pytest.mark.slow
def test_a_scheduler_that_goes_away(photos, output, tmp_path):
    """The command ends with one line, and the same one continues without the cluster."""
    file = tmp_path / "scheduler.json"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}

    def start(*arguments):
        return subprocess.Popen(
            [sys.executable, "-m", *map(str, arguments)],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    options = ("--no-dashboard", "--scheduler-file", file)
    fit = ("eigengs_dr", "fit", photos, "-o", output, "--gaussians", 20, "--iterations", 400)
    processes = [start("dask", "scheduler", "--port", 0, *options)]
    try:
        while not file.exists():
            time.sleep(0.1)
        processes.append(start("dask", "worker", "--nthreads", 1, *options))
        processes.append(start(*fit, "--quiet", "--cluster", file))
        while not list(output.glob("[!.]*.npz")):
            assert processes[2].poll() is None
            time.sleep(0.01)
        processes[0].kill()
        _, message = processes[2].communicate(timeout=60)
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert message.count("\n") == 1
    assert re.match(r"eigengs-dr: error: the scheduler tcp://.* is gone; start it, ", message)
    assert start(*fit, "--quiet").wait() == 0
    assert len(files_of(output)) == 12


# --- Workers that are refused ---


def test_a_cluster_without_workers():
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "0.5s"}),
        LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0") as cluster,
        Client(cluster) as client,
        pytest.raises(eg.ClusterError, match=r"the scheduler .* has no workers; start some"),
    ):
        eg.fit_many([np.zeros((8, 8, 3))], client=client)


def test_other_versions_are_refused(client, tmp_path):
    client.run(clusters.claim_version, str(tmp_path), "drjit", "9.9")
    try:
        line = rf"worker tcp://.* has drjit 9\.9, but this process has {dr.__version__}; install"
        with pytest.raises(eg.ClusterError, match=line):
            eg.fit_many([np.zeros((8, 8, 3))], client=client)
    finally:
        client.run(clusters.leave_version, str(tmp_path))


def test_what_is_no_client_is_refused():
    with pytest.raises(TypeError, match=r"client is a builtins\.str; pass a distributed\.Client"):
        eg.fit_many([np.zeros((8, 8, 3))], client="local:2")


# --- What a cluster has is left as it is ---


def test_a_cluster_of_others_is_as_it_was(counted_threads, tmp_path):
    """After a run, and after an error; their numbers of threads count during a task alone.

    Dask's profiler does not hold the frames of a task: its thread would free the arrays in them.
    """
    image = np.full((8, 8, 3), 0.5, np.float32)
    with (
        LocalCluster(
            n_workers=2, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
        ) as cluster,
        Client(cluster) as client,
    ):
        dr.set_thread_count(2)
        before, plugins = client.run(clusters.worker_state), sorted(cluster.scheduler.plugins)
        noted = replace(eg.DEFAULT, place=FirstCall(clusters.note_task, tmp_path / "task"))
        eg.fit_many([image], client=client, method=noted, gaussians=4, iterations=1)
        assert (tmp_path / "task").read_text() == "1 thread of Dr.Jit, 1 of BLAS, watched: False"
        failing = replace(eg.DEFAULT, place=FirstCall(clusters.fail_with, tmp_path / "freed"))
        with pytest.raises(RuntimeError, match="failed on purpose"):
            eg.fit_many([image], client=client, method=failing, gaussians=4, iterations=1)
        assert (tmp_path / "freed").read_text() == "by the thread of the task"
        deadline = time.monotonic() + 30  # other tasks end after an error
        while (after := client.run(clusters.worker_state)) != before:
            assert time.monotonic() < deadline, after
            time.sleep(0.05)
        assert sorted(cluster.scheduler.plugins) == plugins


def test_two_clients_share_a_cluster(client, photos, tmp_path, expected):
    def fit(folder):
        with Client(client.scheduler.address, set_as_default=False) as other:
            return eg.fit_many(photos, tmp_path / folder, client=other, **QUICK)

    with ThreadPoolExecutor(2) as pool:
        for rows in pool.map(fit, "ab"):
            assert [row.status for row in rows] == ["done"] * 12
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b") == expected

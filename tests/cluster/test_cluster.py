"""On two processes: tasks, fits of a folder and of blocks, a basis; and what survives."""

import logging
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from types import SimpleNamespace

import dask
import drjit as dr
import numpy as np
import pytest
import tifffile
from distributed import Client, LocalCluster
from PIL import Image

import eigengs_dr as eg
from _helpers import clusters
from _helpers.clusters import (
    QUICK,
    DieInWrite,
    files_of,
    folder_of_photos,
    mend_writes,
    slow_writes,
)
from _helpers.families import small_model
from _helpers.low_rank import SIZE, assert_same, family
from _helpers.sets import check_equal
from eigengs_dr.backend.executor import ClusterError, Done
from eigengs_dr.backend.selection import describe
from eigengs_dr.cluster import executor as module
from eigengs_dr.cluster import executor_for
from eigengs_dr.cluster.executor import connect
from eigengs_dr.cluster.local import local_cluster
from eigengs_dr.cluster.worker import Shared, package_versions, run_task, share
from eigengs_dr.eigenbasis import incremental, training
from eigengs_dr.eigenbasis.basis import Eigenbasis
from eigengs_dr.eigenbasis.components import TrainOptions
from eigengs_dr.image.io import save_image
from eigengs_dr.many.manifest import NAME, read_manifest


@pytest.fixture
def photos(tmp_path):
    return folder_of_photos(tmp_path / "photos", 12)


@pytest.fixture
def output(tmp_path):
    return tmp_path / "fits"


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """The results of this process."""
    folder = tmp_path_factory.mktemp("expected")
    eg.fit_many(folder_of_photos(folder / "photos", 12), folder / "here", **QUICK)
    return files_of(folder / "here")


def assert_complete(output, expected):
    """Nothing is lost, nothing is there twice, and nothing is half."""
    assert files_of(output) == expected
    names = sorted(path.name for path in output.iterdir())
    assert names == [*expected, NAME]
    rows, clean = read_manifest(output / NAME)
    assert clean and len((output / NAME).read_text().splitlines()) == len(expected)
    # A result that was written before its row is skipped by the next run.
    assert {row["status"] for row in rows.values()} <= {"done", "skipped"}


def test_the_bits_of_one_process(client, photos, output, expected):
    rows = eg.fit_many(photos, output, client=client, **QUICK)
    assert [row.name for row in rows] == sorted(path.stem for path in photos.iterdir())
    assert_complete(output, expected)
    again = eg.fit_many(photos, output, client=client, **QUICK)
    assert {row.status for row in again} == {"skipped"}
    assert [row.psnr_rgb for row in again] == [row.psnr_rgb for row in rows]


def test_a_basis_and_results_travel(client):
    model = small_model("llvm")
    images = [np.full((32, 32, 3), value, np.float32) for value in (0.3, 0.6)]
    options = {"start": model, "iterations": 2, "backend": "llvm"}
    here = eg.fit_many(images, **options)
    for row, other in zip(eg.fit_many(images, client=client, **options), here, strict=True):
        check_equal(row.result.gaussians, other.result.gaussians.to_arrays())


def test_a_worker_that_is_killed(client, photos, output, expected):
    """It loses what it does, which another worker does again."""
    killed = []

    def kill(done, total, row):
        if not killed:
            killed.append(next(iter(client.run(os.getpid).values())))
            os.kill(killed[0], signal.SIGKILL)

    rows = eg.fit_many(photos, output, client=client, progress=kill, **QUICK)
    assert killed and [row.status for row in rows] == ["done"] * 12
    assert_complete(output, expected)


@pytest.mark.slow
def test_an_image_that_kills_its_worker(client, photos, output, expected):
    """It fails alone; the same call fits it when the cause is gone."""
    client.register_plugin(DieInWrite("05.npz"), name="patch")  # also in workers to come
    rows = eg.fit_many(photos, output, client=client, **QUICK)
    assert [row.name for row in rows if row.status == "failed"] == ["05"]
    assert "05.png: its worker ended 2 times" in rows[5].error
    client.unregister_worker_plugin("patch")
    client.wait_for_workers(2, timeout=60)
    client.run(mend_writes)
    rows = eg.fit_many(photos, output, client=client, **QUICK)
    assert [row.name for row in rows if row.status == "done"] == ["05"]
    left = [path for path in output.iterdir() if path.name.startswith(".")]
    for path in left:  # what the killed worker left goes when it is old
        os.utime(path, (0, 0))
    eg.fit_many(photos, output, client=client, **QUICK)
    assert_complete(output, expected)


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
    assert_complete(output, expected)


@pytest.mark.slow
def test_a_scheduler_that_goes_away(photos, output, expected, tmp_path, caplog):
    """The run ends with one line, and the same call continues without the cluster."""
    logger = logging.getLogger("distributed.client")  # a level of its own, and no parents
    logger.addHandler(caplog.handler)
    level = logger.level
    file = tmp_path / "scheduler.json"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}

    def start(*arguments):
        command = [sys.executable, "-m", "dask", *arguments]
        return subprocess.Popen(
            command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    options = ["--scheduler-file", str(file)]
    processes = [start("scheduler", "--port", "0", "--no-dashboard", *options)]
    try:
        deadline = time.monotonic() + 60
        while not file.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        processes.append(start("worker", "--nthreads", "1", "--no-dashboard", *options))

        def kill(done, total, row):
            processes[0].kill()

        with connect(str(file)) as client:
            client.wait_for_workers(1, timeout=60)
            client.run(slow_writes)
            with pytest.raises(eg.ClusterError, match=r"the scheduler tcp://.* is gone") as error:
                eg.fit_many(photos, output, client=client, progress=kill, **QUICK)
        assert "\n" not in str(error.value) and not caplog.messages
        assert logger.level == level
    finally:
        logger.removeHandler(caplog.handler)
        for process in processes:
            process.kill()
            process.wait()
    rows = eg.fit_many(photos, output, **QUICK)
    assert {row.status for row in rows} == {"skipped", "done"}
    assert_complete(output, expected)


@pytest.mark.slow
def test_a_worker_without_memory(photos, output, expected, monkeypatch):
    """An image that no worker can hold fails; the others do not."""
    monkeypatch.setenv("EIGENGS_DR_MAX_FILE_MB", "1000")  # it is small for what it holds
    Image.fromarray(np.zeros((9000, 9000, 3), np.uint8)).save(photos / "05.png", compress_level=1)
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        local_cluster(2, memory_limit="800MB") as cluster,
        Client(cluster) as client,
    ):
        rows = eg.fit_many(photos, output, client=client, **QUICK)
    assert [row.name for row in rows if row.status == "failed"] == ["05"]
    assert "it may need more memory than a worker has" in rows[5].error
    found = files_of(output)
    assert found == {name: expected[name] for name in expected if name != "05.npz"}


def test_encoded_images_are_those_of_this_process(client, photos, output):
    model = small_model("llvm")
    here = model.encode_many(photos)
    rows = model.encode_many(photos, client=client)
    model.encode_many(photos, output, client=client)
    for row, other in zip(rows, here, strict=True):
        check_equal(row.result, other.result.to_arrays())
        check_equal(eg.Gaussians.load(output / f"{row.name}.npz"), other.result.to_arrays())


def test_blocks_have_the_bits_of_one_process(client, tmp_path):
    picture = (255 * eg.sample("coffee")[:96, :160]).round().astype(np.uint8)
    tifffile.imwrite(tmp_path / "x.tif", picture, tile=(16, 16))
    options = {"iterations": 20, "block": 64, "backend": "llvm"}
    alone = eg.fit_large(tmp_path / "x.tif", **options)
    shared = eg.fit_large(tmp_path / "x.tif", tmp_path / "x.npz", client=client, **options)
    check_equal(shared.gaussians, alone.gaussians.to_arrays())
    assert not (tmp_path / "x.npz.checkpoint").exists()


# --- The eigenbasis ---


@pytest.fixture
def images(monkeypatch):
    """Images for four shards; workers take the sizes from the tasks."""
    monkeypatch.setattr(incremental, "SHARD", 16)
    return family(60)


@pytest.mark.parametrize("stored", [False, True])
def test_a_basis_has_the_bits_of_one_process(client, images, tmp_path, stored):
    checkpoint = tmp_path if stored else None
    found = Eigenbasis.from_images(images, SIZE, 8, client=client, checkpoint=checkpoint)
    assert_same(found, Eigenbasis.from_images(images, SIZE, 8))


def test_iterators_are_refused(client, images):
    with pytest.raises(ValueError, match="a cluster needs a list"):
        Eigenbasis.from_images(iter(images), SIZE, 8, client=client)


def test_training(client, tmp_path, images, monkeypatch):
    """Names are relative to the folder of the client, where no worker runs."""
    (tmp_path / "photos").mkdir()
    for i, image in enumerate(images):
        save_image(tmp_path / "photos" / f"{i:03d}.png", image)
    settings = TrainOptions(size=SIZE, components=6, gaussians=40)
    stages = []

    def progress(done, total, row):
        stages.append((row["stage"], done, total))

    monkeypatch.chdir(tmp_path)
    far = training.train_model("photos", "a.npz", settings, progress=progress, client=client)
    here = training.train_model(tmp_path / "photos", tmp_path / "b.npz", settings)
    assert_same(far.basis, here.basis)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert ("components", 54, 54) in stages
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "b.npz", "photos"]


# --- Tasks: order, errors, what is drawn when, and workers that end ---


@pytest.fixture
def executor(client):
    return executor_for(client)


def done(executor, *arguments):
    return sorted(executor.map(*arguments), key=lambda entry: entry.task)


def test_tasks_run_in_other_processes(executor):
    found = {entry.value for entry in executor.map(clusters.process_of, range(12))}
    assert os.getpid() not in found and len(found) == executor.workers == 2


def test_few_tasks_are_drawn_ahead(executor):
    drawn, most = [], []

    def tasks():
        for task in range(20):
            drawn.append(task)
            yield task

    for ended, _ in enumerate(executor.map(clusters.add, tasks(), 0)):
        most.append(len(drawn) - ended)
    assert max(most) <= module.TASKS_PER_WORKER * 2


def test_errors_are_raised(executor):
    with pytest.raises(ValueError, match="task 0"):
        list(executor.map(clusters.fail, range(1)))


@pytest.mark.slow
def test_a_worker_that_starts_slowly_comes_back(tmp_path):
    """Dask must not give it up while its nanny restarts it."""
    with (
        dask.config.set({"distributed.deploy.lost-worker-timeout": "100ms"}),
        connect("local:1") as client,
    ):
        found = done(executor_for(client), clusters.die_once, range(3), str(tmp_path))
    assert found == [Done(k, k) for k in range(3)]


def test_a_cluster_without_workers(monkeypatch):
    """Before the first task, and after the last worker has gone."""
    monkeypatch.setattr(module, "NO_WORKER_SECONDS", 0.5)
    with user_cluster() as (cluster, client):
        executor = executor_for(client)
        cluster.scale(0)
        with pytest.raises(ClusterError, match="no worker is left; start some"):
            list(executor.map(clusters.add, range(2), 0))
        with pytest.raises(ClusterError, match=r"the scheduler .* has no workers; start some"):
            executor_for(client)


def test_other_versions_are_refused(client):
    """Those of the client, and LLVM among the workers."""
    task = client.submit(share, b"", package_versions() | {"drjit": "9.9"}, pure=False)
    with pytest.raises(ClusterError, match=r"worker tcp://.* has drjit .*began with 9\.9"):
        task.result()
    shared = client.submit(share, b"", package_versions(), pure=False).result()
    llvm = shared.versions["LLVM"]
    assert llvm == describe("llvm")["versions"]["libllvm"]
    other = Shared(b"", shared.versions | {"LLVM": "1.2.3"})
    with pytest.raises(ClusterError, match=rf"has LLVM {llvm}, .* with 1\.2\.3; install equal"):
        client.submit(run_task, b"", other, pure=False).result()


@pytest.mark.parametrize(
    ("package", "line"),
    [
        (None, "a worker lacks eigengs_dr; install the packages of this process there"),
        (SimpleNamespace(__version__="9.9"), "has eigengs_dr 9.9, but this process has"),
    ],
)
def test_workers_without_the_package_are_refused(client, package, line):
    """They get no task, which would end their connection."""
    workers = client.run(os.getpid)
    client.run(clusters.replace_package, package)
    try:
        with pytest.raises(ClusterError, match=re.escape(line)):
            executor_for(client)
    finally:
        client.run(clusters.restore_package)
    assert client.run(os.getpid) == workers


# --- What a cluster has is left as it is ---


@contextmanager
def user_cluster():
    """Two workers that somebody else has started, in this process."""
    with (
        LocalCluster(
            n_workers=2, threads_per_worker=1, processes=False, dashboard_address=":0"
        ) as cluster,
        Client(cluster) as client,
    ):
        yield cluster, client


def test_workers_of_this_machine_are_set_up(client):
    """Also those that were restarted."""
    client.restart(timeout=60)
    executor = executor_for(client)
    for entry in executor.map(clusters.state, range(2)):
        during = entry.value
        assert during["threads"] == 1 and during["blas"] == {1}
        assert during["interrupt"] and during["start"] == "spawn"
    for found in client.run(clusters.worker_state).values():
        assert not (found["pause"] or found["spill"] or found["target"])


@pytest.mark.parametrize("task", [clusters.state, clusters.fail])
def test_a_cluster_of_others_is_as_it_was(task):
    """After a run, and after an error; their numbers of threads count during a task alone."""
    with user_cluster() as (_, client):
        dr.set_thread_count(2)
        executor = executor_for(client)
        before = client.run(clusters.worker_state)
        scheduler = client.cluster.scheduler
        plugins = sorted(scheduler.plugins), sorted(scheduler.worker_plugins)
        if task is clusters.fail:
            with pytest.raises(ValueError, match="task"):
                list(executor.map(task, range(4)))
        else:
            for entry in executor.map(task, range(4)):
                assert entry.value["threads"] == 1 and entry.value["blas"] == {1}
        deadline = time.monotonic() + 30  # other tasks end after an error
        while (after := client.run(clusters.worker_state)) != before:
            assert time.monotonic() < deadline, after
            time.sleep(0.05)
        assert (sorted(scheduler.plugins), sorted(scheduler.worker_plugins)) == plugins


def test_two_clients_share_a_cluster(client, photos, tmp_path, expected):
    threshold = dask.config.get("distributed.admin.large-graph-warning-threshold")

    def fit(folder):
        with Client(client.scheduler.address, set_as_default=False) as other:
            return eg.fit_many(photos, tmp_path / folder, client=other, **QUICK)

    with ThreadPoolExecutor(2) as pool:
        for rows in pool.map(fit, "ab"):
            assert [row.status for row in rows] == ["done"] * 12
    assert_complete(tmp_path / "a", expected)
    assert_complete(tmp_path / "b", expected)
    assert dask.config.get("distributed.admin.large-graph-warning-threshold") == threshold


def test_dask_holds_bytes(executor, client):
    """Its threads must not use Dr.Jit beside a task: values are pickled by the task's thread."""
    held = set()
    for entry in executor.map(clusters.travel, range(8), clusters.Traveller()):
        (here, in_main), (there, in_loop) = entry.value.places
        assert (here, in_main, in_loop) == (os.getpid(), True, False) and there != here
        held |= set().union(*client.run(clusters.held_types).values())
    assert held <= {"bytes", "Shared"} and "Shared" in held


def test_no_profiler_holds_the_frames_of_a_task(executor):
    """Its thread would free the arrays in them."""
    assert not any(entry.value for entry in executor.map(clusters.is_watched, range(2)))


def test_what_a_failed_task_held_is_freed_by_its_thread(executor, tmp_path):
    with pytest.raises(OSError, match="task a"):
        list(executor.map(clusters.fail_with, ["a"], str(tmp_path / "freed")))
    assert (tmp_path / "freed").read_text() == "False"

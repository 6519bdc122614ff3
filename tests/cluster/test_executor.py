"""Tasks on two real processes: order, errors, what is drawn when, and workers that end."""

import os
from types import SimpleNamespace

import dask
import pytest
from distributed import Client

from _helpers import clusters
from eigengs_dr.backend.executor import ClusterError, Done, executor_for
from eigengs_dr.cluster import executor as module
from eigengs_dr.cluster.executor import WorkerSetup, local_cluster, versions


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
    assert max(most) <= module.AHEAD * 2


def test_errors_are_raised(executor):
    with pytest.raises(ValueError, match="task 0"):
        list(executor.map(clusters.fail, range(1)))


def test_a_worker_that_starts_slowly_comes_back(tmp_path):
    """Dask must not give it up while its nanny restarts it."""
    with (
        dask.config.set({"distributed.deploy.lost-worker-timeout": "100ms"}),
        local_cluster(1) as cluster,
        Client(cluster) as client,
    ):
        found = done(executor_for(client), clusters.die_once, range(3), str(tmp_path))
    assert found == [Done(k, k) for k in range(3)]


def test_a_task_that_ends_all_workers_is_given_up(executor):
    found = done(executor, clusters.die_always, range(6), 2)
    assert [entry.task for entry in found if entry.lost] == [2]
    assert "its worker ended 2 times" in found[2].lost
    assert [entry.value for entry in found] == [0, 1, None, 3, 4, 5]


def test_other_versions_are_refused():
    setup = WorkerSetup(local=True, wanted=versions() | {"eigengs_dr": "9.9"})
    with pytest.raises(ClusterError, match=r"tcp://node:1 has eigengs_dr .*, but .* has 9\.9"):
        setup.setup(SimpleNamespace(address="tcp://node:1"))


def test_workers_without_the_package_are_refused(client, monkeypatch):
    def missing(plugin):
        raise ModuleNotFoundError("No module named 'eigengs_dr'", name="eigengs_dr")

    monkeypatch.setattr(client, "register_plugin", missing)
    with pytest.raises(ClusterError, match="the workers have no eigengs_dr; install eigengs-dr"):
        executor_for(client)


def test_workers_are_set_up(executor, client):
    for found in client.run(clusters.state).values():
        assert found == {"threads": 1, "blas": {1}, "interrupt": True, "start": "spawn"}

"""A cluster of two processes on this machine, for all tests of this folder."""

import pytest

pytest.importorskip("distributed")

import dask
from distributed import Client

from eigengs_dr.cluster.executor import LOST_WORKER_SETTING
from eigengs_dr.cluster.local import local_cluster

RESTART_SECONDS = 120.0
"""Time for workers that the test before has ended."""


@pytest.fixture(scope="package")
def shared_client():
    """A client of two workers; a task that ends its worker twice is given up."""
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1} | LOST_WORKER_SETTING),
        local_cluster(2) as cluster,
        Client(cluster) as client,
    ):
        yield client


@pytest.fixture
def client(shared_client):
    """The client, when both workers are there."""
    shared_client.wait_for_workers(2, timeout=RESTART_SECONDS)
    return shared_client

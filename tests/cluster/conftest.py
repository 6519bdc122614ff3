"""A cluster of two processes on this machine, for all tests of a module."""

import pytest

pytest.importorskip("distributed")

import dask
from distributed import Client

from eigengs_dr.cluster.connect import local_cluster


@pytest.fixture(scope="package")
def client():
    """A client of two workers; a task that ends its worker twice is given up."""
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        local_cluster(2) as cluster,
        Client(cluster) as client,
    ):
        yield client

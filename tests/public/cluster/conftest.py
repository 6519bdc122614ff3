"""A cluster of two processes on this machine, for all tests of this folder."""

import pytest

pytest.importorskip("distributed")

import dask
from distributed import Client

import eigengs_dr as eg
from _helpers.clusters import QUICK, files_of, folder_of_photos

RESTART_SECONDS = 120.0
"""Time for workers that the test before has ended."""

SETTINGS = {
    "distributed.scheduler.allowed-failures": 1,  # a task that ends its worker twice is given up
    "distributed.deploy.lost-worker-timeout": "52w",  # workers that start slowly are waited for
}


@pytest.fixture(scope="package")
def shared_client():
    """A client of two workers, as a user starts them."""
    with (
        dask.config.set(SETTINGS),
        Client(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0") as client,
    ):
        yield client


@pytest.fixture
def client(shared_client):
    """The client, when both workers are there."""
    shared_client.wait_for_workers(2, timeout=RESTART_SECONDS)
    return shared_client


@pytest.fixture
def photos(tmp_path):
    return folder_of_photos(tmp_path / "photos", 12)


@pytest.fixture
def output(tmp_path):
    return tmp_path / "fits"


@pytest.fixture(scope="package")
def expected(tmp_path_factory):
    """The results of this process."""
    folder = tmp_path_factory.mktemp("expected")
    eg.fit_many(folder_of_photos(folder / "photos", 12), folder / "here", **QUICK)
    return files_of(folder / "here")

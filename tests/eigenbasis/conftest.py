"""A training that several tests look at."""

import pytest

from _helpers.families import family
from _helpers.photos import SMALL, random_fields
from eigengs_dr.eigenbasis import incremental
from eigengs_dr.eigenbasis.components import TrainOptions
from eigengs_dr.eigenbasis.training import train_model


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """A folder with photos and a model of them, and what the training returned; only to be read."""
    folder = tmp_path_factory.mktemp("trained")
    random_fields(folder / "photos", 30)
    return folder, train_model(folder / "photos", folder / "model.npz", TrainOptions(**SMALL))


@pytest.fixture(scope="session")
def others():
    """Images of the family of `small_basis` that it was not made of."""
    return family(8, seed=1)


@pytest.fixture
def folder(tmp_path):
    return random_fields(tmp_path / "photos", 24)


@pytest.fixture
def output(tmp_path):
    return tmp_path / "model.npz"


@pytest.fixture
def blocks_of(monkeypatch):
    """Make `from_images` work in blocks of so many images, and perhaps in shards of so many."""

    def blocks_of(length, shard=incremental.SHARD):
        monkeypatch.setattr(incremental, "MAX_BLOCK", length)
        monkeypatch.setattr(incremental, "SHARD", shard)

    return blocks_of

"""Eigenbases of small blocks and shards."""

import pytest

from eigengs_dr.eigenbasis.pca import incremental, stream


@pytest.fixture
def blocks_of(monkeypatch):
    """Make `from_images` work in blocks of so many images, and perhaps in shards of so many."""

    def blocks_of(length, shard=stream.SHARD):
        monkeypatch.setattr(incremental, "MAX_BLOCK", length)
        monkeypatch.setattr(stream, "SHARD", shard)

    return blocks_of

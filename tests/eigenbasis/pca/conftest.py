"""Eigenbases of small blocks."""

import pytest

from eigengs_dr.eigenbasis.pca import incremental


@pytest.fixture
def blocks_of(monkeypatch):
    """Make `from_images` work in blocks of so many images."""
    return lambda length: monkeypatch.setattr(incremental, "MAX_BLOCK", length)

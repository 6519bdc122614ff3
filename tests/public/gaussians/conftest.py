"""A file that tests write, or make by hand."""

import pytest


@pytest.fixture
def path(tmp_path):
    return tmp_path / "x.npz"

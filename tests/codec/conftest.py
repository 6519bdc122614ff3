"""The file that tests write."""

import pytest


@pytest.fixture
def path(tmp_path):
    return tmp_path / "x.egs"

"""Photos to fit, and where the results go."""

import pytest

from _helpers.clusters import folder_of_photos


@pytest.fixture
def photos(tmp_path):
    return folder_of_photos(tmp_path / "photos", 3)


@pytest.fixture
def output(tmp_path):
    return tmp_path / "fits"

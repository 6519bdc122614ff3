"""Photos to fit, and where the results go."""

import pytest
from PIL import Image

from _helpers.clusters import folder_of_photos
from _helpers.command import smooth_pixels


@pytest.fixture
def photos(tmp_path):
    """A folder of four images of two sizes; the first two have one."""
    folder = folder_of_photos(tmp_path / "photos", 4)
    Image.fromarray(smooth_pixels(24, 24)).save(folder / "02.png")
    return folder


@pytest.fixture
def output(tmp_path):
    return tmp_path / "fits"

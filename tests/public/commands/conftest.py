"""Files that commands read and write."""

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.command import SMALL, run, smooth_pixels, succeeded
from _helpers.photos import random_fields


@pytest.fixture
def photo(tmp_path):
    """A photo in the folder of a test."""
    path = tmp_path / "photo.png"
    Image.fromarray(smooth_pixels(32, 32)).save(path)
    return path


@pytest.fixture(scope="session")
def fitted(tmp_path_factory):
    """The outputs of one small fit; tests read them only."""
    folder = tmp_path_factory.mktemp("fitted")
    Image.fromarray(smooth_pixels(32, 32)).save(folder / "photo.png")
    outputs = ["-o", folder / "fit.npz", "--report", folder / "fit.json"]
    settings = ["--gaussians", 64, "--iterations", 5, "--preview", folder / "both.png"]
    result = succeeded(run("fit", folder / "photo.png", *outputs, *settings))
    return folder, result


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """A folder with images, a model of them and all that was said of it; tests read them only."""
    folder = tmp_path_factory.mktemp("trained")
    random_fields(folder / "photos", 12)
    outputs = ["-o", folder / "m.npz", "--report", folder / "m.json", "--preview", folder / "m.png"]
    result = run("train", folder / "photos", *outputs, *SMALL, "--frequency-aware", "yes")
    return folder, succeeded(result)


@pytest.fixture
def existing(tmp_path):
    """An output file of an earlier run, which a refused run has to leave as it is."""
    path = tmp_path / "existing.npz"
    one = np.ones((1, 2)), [[1, 0, 1]], np.ones((1, 3))
    eg.Gaussians.from_arrays(*one, size=(4, 4)).save(path)
    before, earlier = sorted(tmp_path.iterdir()), path.read_bytes()
    yield path
    assert path.read_bytes() == earlier
    assert set(before) <= set(tmp_path.iterdir())

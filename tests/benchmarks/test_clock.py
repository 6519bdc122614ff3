"""Descents under observation, programs in turns, sets of images and their models."""

from functools import partial

import numpy as np
import pytest

from _helpers.benchmarks import data, one_image, task_in  # noqa: F401  data is a fixture
from _helpers.families import family
from eigengs_bench import clock, images
from eigengs_bench.names import PRESETS as NAMES
from eigengs_bench.names import SETS, ImageSet
from eigengs_dr.fitting.options import PRESETS
from eigengs_dr.image.io import ImageError, save_image


def test_presets_have_the_names_of_the_package():
    assert tuple(PRESETS) == NAMES


def test_programs_take_turns():
    order, seen = [], []
    programs = {name: partial(order.append, name) for name in "ab"}
    ms = clock.interleaved(programs, 1, 2, lambda *step: seen.append(step))
    assert "".join(order) == "ababab" and seen == [(1, 3), (2, 3), (3, 3)]
    assert set(ms) == {"a", "b"} and all(value >= 0 for value in ms.values())


def test_images_are_the_first_ones_at_the_size_of_their_set(tmp_path, monkeypatch):
    monkeypatch.setitem(SETS, "kodak", ImageSet("photos", 30, 20, 50))
    (tmp_path / "photos").mkdir()
    for name, shape in (("b", (40, 20, 3)), ("a", (40, 60, 3)), ("c", (9, 9, 3))):
        save_image(tmp_path / "photos" / f"{name}.png", np.full(shape, 0.5))
    task = task_in(tmp_path, data=tmp_path, images=2)
    shapes = {name: image.shape for name, image in images.images_of(task, "kodak")}
    assert shapes == {"a.png": (20, 30, 3), "b.png": (30, 20, 3)}
    assert [name for name, _ in images.images_of(task, "samples", 1)] == ["chelsea"]
    with pytest.raises(ImageError, match="cars256"):
        images.images_of(task, "cars256")


def test_models_are_trained_once_on_the_training_images(tmp_path, backend, data):  # noqa: F811
    arguments = (task_in(tmp_path, backend, data), "cats256", "natural256", 4, "rgb")
    model = images.model_for(*arguments, True)
    assert model.components == (4, 4, 4)
    assert len(model.gaussians) == 60 and model.low == 6 and model.gaussians.space == "rgb"
    expected = family(16, seed=1)[2:].mean(axis=(0, 1, 2))
    assert np.allclose(model.mean_image.mean(axis=(1, 2)), expected, atol=5e-3)
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "models").iterdir()}
    images.model_for(*arguments, True)
    images.model_for(*arguments)  # another model of the same basis
    assert files.items() <= {p: p.stat().st_mtime_ns for p in files}.items() and len(files) == 2

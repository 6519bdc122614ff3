"""What users read when they mistype, or pass something else."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg


@pytest.fixture(scope="module")
def photo():
    return eg.sample("coffee")[:32, :32]


@pytest.mark.parametrize("name", ["fit", "fit_many", "fit_large"])
def test_a_mistyped_option_says_the_right_one(name, photo):
    text = "^unknown option 'itertions'; did you mean 'iterations'\\?$"
    with pytest.raises(TypeError, match=text):
        getattr(eg, name)(photo, itertions=5)
    with pytest.raises(TypeError, match=r"unknown option 'zzz'; use one of .*iterations"):
        getattr(eg, name)(photo, zzz=5)


def test_mistaken_arguments_name_the_function(photo):
    g = eg.fit(photo, 20, iterations=0).gaussians
    with pytest.raises(TypeError, match=r"^render\(\) got an unexpected keyword argument 'scale'$"):
        eg.render(g, scale=2)
    with pytest.raises(TypeError, match=r"^pack\(\) missing a required argument: 'output'$"):
        eg.pack(g)


def test_arrays_of_other_shapes_are_refused_by_name(photo):
    g = eg.fit(photo, 20, iterations=0).gaussians
    with pytest.raises(ValueError, match=r"mean has shape \(7, 2\), expected \(20, 2\)"):
        eg.render(replace(g, mean=g[:7].mean))
    with pytest.raises(ValueError, match=r"mean has shape \(20, 3\), expected \(20, 2\)"):
        eg.render(replace(g, mean=g.factor))


def test_warnings_point_at_the_line_of_the_user(photo, tmp_path):
    from PIL import Image

    Image.fromarray(np.zeros((32, 32, 4), np.uint8)).save(tmp_path / "a.png")
    (tmp_path / "photos").mkdir()
    eg.save_image(tmp_path / "photos" / "b.png", photo)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        eg.load_image(tmp_path / "a.png")
        eg.fit(tmp_path / "a.png", 20, iterations=0)
        eg.Eigenbasis.from_images(tmp_path / "photos", size=(16, 16), components=3)
    assert len(found) >= 4
    assert {warning.filename for warning in found} == {__file__}

"""A public name that is spelt wrong, asked as an attribute of a module."""

import importlib

import pytest

import eigengs_dr as eg


@pytest.mark.parametrize(
    ("module", "wrong", "right"),
    [
        ("eigengs_dr", "fti", "fit"),
        ("eigengs_dr", "fit_manny", "fit_many"),
        ("eigengs_dr", "Gaussian", "Gaussians"),
        ("eigengs_dr", "eigengs", "EigenGS"),
        ("eigengs_dr", "PSNR", "psnr"),
        ("eigengs_dr.plugins", "texture_off", "texture_of"),
        ("eigengs_dr.plugins", "photoloss", "photo_loss"),
    ],
)
def test_the_error_of_a_wrong_name_names_the_right_one(module, wrong, right):
    if module.endswith("plugins"):
        pytest.importorskip("mitsuba", reason="plugins need mitsuba")
    with pytest.raises(AttributeError) as caught:
        getattr(importlib.import_module(module), wrong)
    text = f"module '{module}' has no attribute '{wrong}'; did you mean '{right}'?"
    assert str(caught.value) == text and caught.value.name == wrong


@pytest.mark.parametrize("name", ["xyzzy", "__wrapped__", "_fit"])
def test_nothing_is_suggested_for_what_is_like_no_name(name):
    with pytest.raises(AttributeError) as caught:
        getattr(eg, name)
    assert str(caught.value) == f"module 'eigengs_dr' has no attribute '{name}'"
    assert not hasattr(eg, name)


def test_the_listed_names_are_the_public_ones():
    assert dir(eg) == sorted(eg.__all__) and "fit" in dir(eg) and "fti" not in dir(eg)
    assert all(name in dir(eg) for name in ("EigenGS", "Relightable", "plugins", "view"))

"""Spaces of colours as a user names them; normal maps in fits and files."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.errors import refused
from _helpers.light import to_coded, to_log
from _helpers.packed import few_groups
from _helpers.sets import random_scene

NAMES = ["ycbcr", "rgb", "linear", "data", "radiance", "log", "normal"]


@pytest.mark.parametrize("name", NAMES)
def test_a_set_takes_a_name_and_has_a_space(name):
    space = random_scene().on("llvm", space=name).space
    assert space == name and f"{space}" == name and repr(space) == repr(name)
    assert pickle.loads(pickle.dumps(space)) is copy.deepcopy(space) is space
    assert replace(random_scene().on("llvm"), space=name).space is space


@pytest.mark.parametrize("space", ["linear", "radiance", "log"])
def test_light_is_shown_as_codes(space):
    """A set without Gaussians shows its background."""
    light = np.array([0.18, 1, 12]) if space != "linear" else np.array([0.18, 0.5, 1])
    values = to_log(light) if space == "log" else light
    scene = random_scene()._replace(color=np.zeros((24, 3)), background=values)
    picture = eg.picture_of(scene.on("llvm", space=space))
    np.testing.assert_allclose(picture[8, 9], to_coded(light), rtol=1e-4)


# --- Normal maps ---


def bumps(side=32):
    """A normal map of waves, shape (side, side, 3), in codes."""
    y, x = np.mgrid[:side, :side] / side
    n = np.stack([0.4 * np.sin(9 * x + 2 * y), 0.4 * np.cos(7 * y), np.ones_like(x)], axis=2)
    n /= np.linalg.norm(n, axis=2, keepdims=True)
    return (0.5 + 0.5 * n).astype(np.float32)


def test_a_rendering_is_the_sum_with_the_length_1(backend):
    g = random_scene(3).on(backend, space="normal")
    vectors = 2 * eg.render(replace(g, space="data")).numpy() - 1
    expected = 0.5 + 0.5 * vectors / np.linalg.norm(vectors, axis=2, keepdims=True)
    np.testing.assert_allclose(eg.render(g).numpy(), expected, atol=1e-5)
    np.testing.assert_allclose(eg.picture_of(g), expected, atol=1e-5)


@few_groups()
def test_a_fit_has_unit_normals_and_its_file_too(tmp_path):
    result = eg.fit(bumps(), 60, iterations=10, space="normal")
    np.testing.assert_allclose(np.linalg.norm(2 * result.image - 1, axis=2), 1, atol=1e-5)
    assert result.trace[-1]["psnr_ycbcr"] > 30
    few = result.gaussians[:8]
    few.save(tmp_path / "n.npz")
    eg.pack(few, tmp_path / "n.egs")
    for name, loss in (("n.npz", 1e-5), ("n.egs", 0.1)):
        loaded = eg.Gaussians.load(tmp_path / name)
        assert loaded.space == "normal"
        np.testing.assert_allclose(eg.render(loaded), eg.render(few), atol=loss)


def test_what_is_no_normal_map():
    with refused(eg.ImageError, "a normal map has three channels; use space 'data'"):
        eg.fit(bumps()[..., :1], 10, iterations=0, space="normal")
    with refused(eg.ImageError, r"normals run from -.* not 0 to 1; pass \(n \+ 1\) / 2"):
        eg.fit(2 * bumps() - 1.5, 10, iterations=0, space="normal")

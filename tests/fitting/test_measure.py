"""PSNRs of a set by a kernel, beside those of its picture."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.sets import random_scene
from eigengs_dr.fitting.measure import Shown, psnrs
from eigengs_dr.image.metrics import float_space


def near(picture, seed=0):
    """An image like a picture, within [0, 1]."""
    noise = np.random.default_rng(seed).normal(0, 0.05, picture.shape)
    return np.clip(picture + noise, 0, 1).astype(np.float32)


def expected(picture, image, space):
    return [eg.psnr(picture, image, space=name) for name in (float_space(space), "rgb")]


@pytest.mark.parametrize("space", ["ycbcr", "rgb", "linear", "radiance", "log", "normal", "data"])
@pytest.mark.parametrize("size", [(22, 17), (16, 16)])
def test_psnrs_are_those_of_the_picture(backend, space, size):
    gaussians = random_scene(size=size).on(backend, space=space)
    picture = eg.picture_of(gaussians)
    image = near(picture)
    found = psnrs(gaussians, [Shown(image, space)])
    assert found.shape == (1, 2, 1)
    np.testing.assert_allclose(found[0, :, 0], expected(picture, image, space), atol=1e-3)


def test_what_comes_on_top_counts(backend):
    gaussians = random_scene().on(backend, space="ycbcr")
    picture, base = eg.picture_of(gaussians), np.float32(0.1) + 0 * eg.picture_of(gaussians)
    image = near(picture + base)
    found = psnrs(gaussians, [Shown(image, "ycbcr", base=base)])[0, :, 0]
    np.testing.assert_allclose(found, expected(picture + base, image, "ycbcr"), atol=1e-3)


def test_a_set_without_error_has_no_finite_psnr(backend):
    black = eg.Gaussians.from_arrays(
        np.array([[4.0, 4.0]]),
        np.array([[0.5, 0, 0.5]]),
        np.zeros((1, 3)),
        size=(8, 8),
        space="rgb",
        backend=backend,
    )
    image = np.zeros((8, 8, 3), np.float32)
    assert np.isinf(psnrs(black, [Shown(image, "rgb")])).all()
    assert np.isnan(psnrs(black, [Shown(image * np.nan, "rgb")])).all()

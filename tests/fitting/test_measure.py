"""PSNRs of a set by a kernel, beside those of its picture."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.sets import random_scene
from eigengs_dr.backend.arrays import types_of
from eigengs_dr.fitting.measure import psnrs
from eigengs_dr.fitting.objective import Channels, Target
from eigengs_dr.image.space import Affine, space_of
from eigengs_dr.raster.render import batch_to_tiles


def near(image, seed=0):
    """An image like another, within [0, 1]."""
    noise = np.random.default_rng(seed).normal(0, 0.05, image.shape)
    return np.clip(image + noise, 0, 1).astype(np.float32)


def shown(gaussians, image, space, weight=None):
    """What a set shows of an image that is fitted as it is."""
    part, target = slice(0, image.shape[2]), Target(image, image, Affine())
    channels = Channels("", space_of(space), part, (target,))
    return channels.picture(types_of(gaussians.mean), weight)


def expected(rendered, image, space):
    return [eg.psnr(rendered, image, space=name) for name in (space_of(space).figure, "rgb")]


@pytest.mark.parametrize("space", ["ycbcr", "rgb", "linear", "radiance", "log", "normal", "data"])
@pytest.mark.parametrize("size", [(22, 17), (16, 16)])
def test_psnrs_are_those_of_the_picture(backend, space, size):
    gaussians = random_scene(size=size).on(backend, space=space)
    rendered = eg.picture_of(gaussians)
    image = near(rendered)
    found = psnrs(gaussians, [shown(gaussians, image, space)])
    assert found.shape == (1, 2, 1)
    np.testing.assert_allclose(found[0, :, 0], expected(rendered, image, space), atol=1e-3)


def test_what_comes_on_top_counts(backend):
    gaussians = random_scene().on(backend, space="ycbcr")
    rendered = eg.picture_of(gaussians)
    base = np.full_like(rendered, 0.1)
    image = near(rendered + base)
    tiles = batch_to_tiles(types_of(gaussians.mean), base)
    found = psnrs(gaussians, [shown(gaussians, image, "ycbcr")._replace(base=tiles)])[0, :, 0]
    np.testing.assert_allclose(found, expected(rendered + base, image, "ycbcr"), atol=1e-3)


@pytest.mark.parametrize("space", ["ycbcr", "rgb", "linear", "radiance", "log", "normal", "data"])
def test_weights_are_those_of_squared_errors(backend, space):
    """Of two halves with weights of 1 and 3.

    Pixels without weight do not count, whatever they are.
    """
    gaussians = random_scene().on(backend, space=space)
    rendered = eg.picture_of(gaussians)
    image, height = near(rendered), len(rendered)
    weight = np.zeros(image.shape[:2], np.float32)
    weight[: height // 2], weight[height // 2 : -3] = 1, 3
    image[-3:] = 1 - image[-3:]
    found = psnrs(gaussians, [shown(gaussians, image, space, weight)])[0, :, 0]
    parts = slice(height // 2), slice(height // 2, -3)
    errors = [10 ** (-np.array(expected(rendered[p], image[p], space)) / 10) for p in parts]
    areas = [len(rendered[p]) for p in parts]
    mse = (errors[0] * areas[0] + 3 * errors[1] * areas[1]) / (areas[0] + 3 * areas[1])
    np.testing.assert_allclose(found, -10 * np.log10(mse), atol=1e-3)


def test_weights_of_channels_count_by_their_mean(backend):
    gaussians = random_scene().on(backend, space="rgb")
    image = near(eg.picture_of(gaussians))
    weight = np.random.default_rng(0).uniform(0, 1, image.shape).astype(np.float32)
    found = [
        psnrs(gaussians, [shown(gaussians, image, "rgb", w)]) for w in (weight, weight.mean(axis=2))
    ]
    np.testing.assert_array_equal(*found)


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
    assert np.isinf(psnrs(black, [shown(black, image, "rgb")])).all()
    assert np.isnan(psnrs(black, [shown(black, image * np.nan, "rgb")])).all()

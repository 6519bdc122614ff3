"""Sums at scattered points: values, slopes and gradients, against float64 without any lists."""

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from _helpers.footprints import check_gradient, coordinates, exact_at, some_points, stacked
from _helpers.sets import SIZE, few, random_scene, scenes
from _oracles.lookups import cells_of, squares, sums_at
from eigengs_dr.backend.selection import select
from eigengs_dr.raster.lookup.points import gradient_terms

POINTS = np.concatenate([np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * SIZE, some_points(396)])
"""Points in the image, its corners among them, shape (points, 2)."""

WIDE = 9.0
"""A cutoff at which a splat's edge is nothing: finite differences may cross it."""


@few
@given(scene=scenes(), side=st.sampled_from([1, 2, 4, 64]))
def test_all_splats_that_reach_a_point_are_summed(backend, scene, side):
    exact, sure = exact_at(scene, POINTS, 3.0)
    found = stacked(sums_at(scene.on(backend), POINTS, side=side))
    np.testing.assert_allclose(found[sure], exact[sure], atol=2e-5)


def many(backend, mean=None):
    """More Gaussians than 16 bits can number, all over an image or at one place."""
    scene = random_scene(2, 70_000, (64, 64))
    scene = scene._replace(
        factor=np.tile([0.6, 0.1, 0.5], (70_000, 1)),
        color=np.float32(scene.color / 100).astype(float),
        mean=scene.mean if mean is None else np.full_like(scene.mean, mean),
    )
    return scene, scene.on(backend)


def test_more_gaussians_than_16_bits_number(backend):
    """Lists then go by bands of rows."""
    scene, gaussians = many(backend)
    points = some_points(100, (64, 64))
    assert dr.width(cells_of(gaussians).first) > 1
    exact, _ = exact_at(scene, points, 5.0)
    np.testing.assert_allclose(stacked(sums_at(gaussians, points, 5.0)), exact, atol=1e-4)


def test_too_many_gaussians_of_one_cell_are_a_mistake(backend):
    with pytest.raises(ValueError, match="more than 65,535 Gaussians touch 4 rows of pixels"):
        cells_of(many(backend, 30.0)[1])


def test_the_gradient_is_a_finite_difference(backend):
    def loss(gaussians):
        return squares(sums_at(gaussians, POINTS, WIDE))

    check_gradient(loss, random_scene(7), backend)


def test_the_gradient_reaches_the_point(backend):
    """The loop hands on derivatives of where it is evaluated: slopes, as `gradient_terms` gives."""
    gaussians = random_scene(8).on(backend, bits=64)
    x, y = coordinates(select(backend).Float64, POINTS)
    dr.enable_grad(x, y)
    dr.backward(dr.sum(sums_at(gaussians, (x, y), WIDE)[0]))
    rows = sums_at(gaussians, POINTS, WIDE, terms=gradient_terms, number=3)
    np.testing.assert_allclose(np.array(dr.grad(x)), np.array(rows[1]), atol=1e-9)
    np.testing.assert_allclose(np.array(dr.grad(y)), np.array(rows[2]), atol=1e-9)

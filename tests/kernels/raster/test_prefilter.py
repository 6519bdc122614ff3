"""Sums seen through a footprint, against brute force, and their gradients."""

import numpy as np
import pytest

from _helpers.footprints import (
    CUTOFF,
    around,
    brute_force,
    check_gradient,
    exact_at,
    matrices,
    some_points,
    stacked,
)
from _helpers.sets import SIZE, random_scene
from _oracles.lookups import filtered, squares
from eigengs_dr.raster.lookup.footprint import MAX_FOOTPRINT

FOOTPRINTS = [
    np.diag([0.3, 0.3]),
    np.array([[9.0, 4.0], [4.0, 3.0]]),
    np.diag([60.0, 0.5]),
    np.diag((MAX_FOOTPRINT * np.array(SIZE)) ** 2),
]
"""Covariances in pixels squared: small, leaning, a long one, and the largest there is."""


@pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
@pytest.mark.parametrize("k", range(len(FOOTPRINTS)))
def test_what_brute_force_sees(backend, wrap, k):
    """Exact but for the tails of footprints, and near corners: see `inside_share`."""
    scene, points = random_scene(1, 60), around(some_points(), wrap)
    scene = scene._replace(mean=0.2 * np.array(SIZE) + 0.6 * scene.mean)
    corner = np.abs(points - np.round(points / SIZE) * SIZE).max(axis=1) < 3
    exact = brute_force(scene, wrap, points, FOOTPRINTS[k])
    found = stacked(filtered(scene.on(backend), wrap, points, FOOTPRINTS[k], CUTOFF))
    error = np.abs(found + scene.background - exact)
    assert np.abs(exact - exact.mean(axis=0)).max() > 0.05
    assert error[~corner].max() < 0.03
    assert error.mean() < 0.005


def test_splats_outside_of_the_image_are_seen_over_its_border(backend):
    """Up to the last cells of the table; a footprint next to nothing sees the sum itself."""
    scene, rng = random_scene(6, 60), np.random.default_rng(1)
    mean = scene.mean.copy()
    mean[:30, 0] = SIZE[0] + rng.uniform(1, 4, 30)
    mean[30:, 1] = SIZE[1] + rng.uniform(1, 4, 30)
    scene = scene._replace(mean=mean, factor=np.tile([0.5, 0.0, 0.5], (60, 1)))
    points = some_points()
    points[:30, 0], points[30:, 1] = SIZE[0] - 0.05, SIZE[1] - 0.05
    exact, sure = exact_at(scene, points, 2.0, margin=0.01)
    found = stacked(filtered(scene.on(backend), "mirror", points, np.diag([0.01, 0.01]), 2.0))
    assert sure.sum() > 30 and np.abs(exact[sure]).max() > 0.1
    np.testing.assert_allclose(found[sure], exact[sure], atol=0.05 * np.abs(exact).max())


@pytest.mark.parametrize(("wrap", "count"), [("repeat", 400), ("clamp", 70_000)])
def test_nothing_is_left_out_far_from_borders(backend, wrap, count):
    """Gaussians that differ a thousandfold in size, and long, turned footprints; and more
    Gaussians than 16 bits number, whose lists go by bands."""
    size, rng = (128, 96), np.random.default_rng(4)
    factor = np.tile([1.2, 0.3, 0.9], (count, 1)) * 1000 ** rng.uniform(-0.1, 0.9, (count, 1))
    mean = rng.uniform(0.3, 0.7, (count, 2)) * size
    scene = random_scene(4, count, size)._replace(mean=mean, factor=factor)
    points = some_points(60 if count == 400 else 10, size) * 0.2 + 0.4 * np.array(size)
    for xx, yy, xy in ((0.3, 0.3, 0.0), (9, 3, 4), (30, 30, 27)):
        covariance = np.array([[xx, xy], [xy, yy]])
        spread = matrices(*scene.factor.T) + covariance
        inverse = np.linalg.inv(spread)
        dx, dy = np.moveaxis(points[:, None] - scene.mean, -1, 0)
        q = inverse[:, 0, 0] * dx**2 + 2 * inverse[:, 0, 1] * dx * dy + inverse[:, 1, 1] * dy**2
        scale = np.sqrt(np.linalg.det(spread - covariance) / np.linalg.det(spread))
        exact = (np.where(q <= 9, np.exp(-0.5 * q), 0) * scale) @ scene.color
        found = stacked(filtered(scene.on(backend), wrap, points, covariance, 3.0))
        np.testing.assert_allclose(found, exact, atol=2e-3 * np.sqrt(count / 400))


def test_the_gradient_is_a_finite_difference(backend):
    """Points inside and at borders, so that both ways of summing are seen; in float64."""
    points = around(some_points(40), "clamp")
    for covariance in FOOTPRINTS[1:3]:

        def loss(gaussians, covariance=covariance):
            return squares(filtered(gaussians, "clamp", points, covariance, 9.0))

        check_gradient(loss, random_scene(5, 9), backend)


def test_a_set_that_is_nowhere_gives_nothing(backend):
    scene = random_scene(1, 60)
    scene = scene._replace(mean=scene.mean + 1e6)
    rows = stacked(filtered(scene.on(backend), "repeat", some_points(), FOOTPRINTS[1], CUTOFF))
    np.testing.assert_array_equal(rows, 0)

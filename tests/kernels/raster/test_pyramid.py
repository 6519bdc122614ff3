"""Distant views: lattices against brute force and against exact lookups; their gradients."""

import drjit as dr
import numpy as np
import pytest

from _helpers.footprints import (
    CUTOFF,
    around,
    brute_force,
    check_gradient,
    coordinates,
    some_points,
    stacked,
    tiled,
)
from _helpers.sets import SIZE, random_scene
from _oracles.lookups import classes_of, footprint_of, squares
from eigengs_dr.backend.arrays import types_of
from eigengs_dr.raster.lookup.prefilter import sum_prefiltered
from eigengs_dr.raster.lookup.pyramid import (
    SAMPLE_DEVIATION,
    build_pyramid,
    is_minified,
    levels_of,
    pyramid_mean,
    sum_pyramid,
)

FOOTPRINTS = [
    np.diag([1.0, 1.0]),
    np.diag([60.0, 1.5]),
    np.array([[30.0, -12.0], [-12.0, 14.0]]),
    np.diag((0.4 * np.array(SIZE)) ** 2),
]
"""Covariances in pixels squared that a lattice of one pixel serves, or a coarser one."""

MANY = 130
"""Gaussians of an image of `SIZE` for which the finest level has a point for each pixel."""


def lattice_of(gaussians, wrap="repeat", cutoff=CUTOFF):
    sizes, packed = classes_of(gaussians, wrap, cutoff)
    return build_pyramid(sizes, packed)


def looked_up(lattice, points, covariance):
    types = types_of(lattice.scale)
    footprint = footprint_of(types.Float, covariance)
    assert np.array(is_minified(lattice, footprint)).all()
    return sum_pyramid(lattice, *coordinates(types.Float, points), footprint, types.Bool(True))


def inner_scene(seed=1, count=MANY, size=SIZE):
    """Splats whose middles lie inside the image, whose sum varies as that of 60."""
    scene = random_scene(seed, count, size)
    color = scene.color * np.sqrt(min(1, 40 / count))
    return scene._replace(mean=0.2 * np.array(size) + 0.6 * scene.mean, color=color)


@pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
def test_what_brute_force_sees(backend, wrap):
    """Also the mean, which is that of a fine picture."""
    scene, points = inner_scene(), around(some_points(), wrap)
    lattice = lattice_of(scene.on(backend), wrap)
    for covariance in FOOTPRINTS:
        exact = brute_force(scene, wrap, points, covariance)
        error = np.abs(stacked(looked_up(lattice, points, covariance)) + scene.background - exact)
        assert error.max() < 0.03
        assert error.mean() < 0.005
    fine = tiled(scene, "repeat", copies=0)[0].mean(axis=(0, 1))
    mean = scene.background + np.array(pyramid_mean(lattice)).ravel()
    np.testing.assert_allclose(mean, fine, atol=0.01)


def test_the_gradient_is_a_finite_difference(backend):
    """Through the lattice to the splats behind it, in float64, which is not halved."""
    scene, points = inner_scene(5, 9), around(some_points(40), "mirror")
    double = lattice_of(scene.on(backend, bits=64), "mirror", 9.0)
    assert double.halved() is double

    def loss(gaussians):
        lattice = lattice_of(gaussians, "mirror", 9.0)
        return squares(looked_up(lattice, points, FOOTPRINTS[2])) + pyramid_mean(lattice)[0]

    check_gradient(loss, scene, backend)


@pytest.mark.parametrize(
    ("size", "count", "number"), [((64, 64), 1400, 4), ((7, 300), 5, 1), ((64, 32), 200, 2)]
)
def test_there_are_as_many_points_as_the_gaussians_need(size, count, number):
    """No spacing is below a pixel, and the coarsest level has few points."""
    levels = levels_of(*size, count, "repeat")
    assert len(levels) == number
    for level in levels:
        assert level.nx * level.dx == pytest.approx(size[0])
        assert level.ny * level.dy == pytest.approx(size[1])
        assert min(level.dx, level.dy) >= 1


def test_half_precision_keeps_what_8_bits_show(backend):
    """Relative to the brightest value, whatever the unit of the light."""
    scene, points = inner_scene(), some_points()
    for brightness in (1e-3, 1e6):
        lattice = lattice_of(scene._replace(color=brightness * scene.color).on(backend))
        half = lattice.halved()
        assert dr.itemsize_v(half.values) == 2
        found, expected = (stacked(looked_up(k, points, FOOTPRINTS[2])) for k in (half, lattice))
        np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())
        means = [np.array(pyramid_mean(k)).ravel() for k in (half, lattice)]
        np.testing.assert_allclose(*means, atol=1e-4 * np.abs(expected).max())


def test_the_finest_level_is_the_filtered_sum(backend):
    """At every point, although most are rendered and only the border is looked up."""
    gaussians = random_scene(3, MANY).on(backend)
    types, level = types_of(gaussians.mean), levels_of(*SIZE, MANY, "mirror")[0]
    index = dr.arange(types.UInt, level.columns * level.rows)
    x = (types.Float(index % level.columns) + 0.5 - level.pad) * level.dx
    y = (types.Float(index // level.columns) + 0.5 - level.pad) * level.dy
    blur = footprint_of(
        types.Float, np.diag([(SAMPLE_DEVIATION * k) ** 2 for k in (level.dx, level.dy)])
    )
    classes = classes_of(gaussians, "mirror", CUTOFF)
    expected = stacked(sum_prefiltered(*classes, x, y, blur, types.Bool(True)))
    found = np.array(lattice_of(gaussians, "mirror").values)
    found = found[: 4 * level.columns * level.rows].reshape(-1, 4)[:, :3]
    np.testing.assert_allclose(found, expected, atol=3e-5)

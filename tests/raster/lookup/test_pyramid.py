"""Distant views: lattices against brute force and against exact lookups; their gradients."""

from dataclasses import replace

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
from eigengs_dr.backend.arrays import types_of, upload_rows
from eigengs_dr.raster.lookup import pyramid as coarsen
from eigengs_dr.raster.lookup.points import Packed, invert
from eigengs_dr.raster.lookup.prefilter import sum_prefiltered
from eigengs_dr.raster.lookup.pyramid import is_minified, pyramid_mean, sum_pyramid
from eigengs_dr.raster.lookup.size_classes import classify_by_size
from eigengs_dr.raster.render import decode_parameters

FOOTPRINTS = [
    np.diag([1.0, 1.0]),
    np.diag([4.0, 4.0]),
    np.array([[9.0, 4.0], [4.0, 3.5]]),
    np.diag([60.0, 1.5]),
    np.array([[30.0, -12.0], [-12.0, 14.0]]),
    np.diag((0.4 * np.array(SIZE)) ** 2),
]
"""Covariances in pixels squared that a lattice of one pixel serves, or a coarser one."""

MANY = 130
"""Gaussians of an image of `SIZE` for which the finest level has a point for each pixel."""


def arrays_of(gaussians, wrap, cutoff=CUTOFF):
    """What `build_pyramid` takes."""
    p = decode_parameters(gaussians)
    shape = [dr.detach(r) for r in p.shape]
    sizes = classify_by_size(shape, gaussians.width, gaussians.height, cutoff, wrap)
    rows = sizes.cells.pack(*invert(p.shape, p.color))
    packed = Packed(rows, gaussians.channels, cutoff, inverted=True)
    finest = coarsen.list_finest(shape, gaussians.width, gaussians.height, packed.radius, True)
    return sizes, packed, finest, p.shape, p.color


def lattice_of(*given):
    return coarsen.build_pyramid(*arrays_of(*given))


def looked_up(lattice, points, covariance):
    types = types_of(lattice.scale)
    x, y = coordinates(types.Float, points)
    entries = (float(covariance[k]) for k in ((0, 0), (0, 1), (1, 1)))
    footprint = [dr.opaque(types.Float, entry) for entry in entries]
    assert np.array(is_minified(lattice, footprint)).all()
    return sum_pyramid(lattice, x, y, footprint, types.Bool(True))


def inner_scene(seed=1, count=MANY, size=SIZE):
    """Splats whose middles lie inside the image, whose sum varies as that of 60."""
    scene = random_scene(seed, count, size)
    color = scene.color * np.sqrt(min(1, 40 / count))
    return scene._replace(mean=0.2 * np.array(size) + 0.6 * scene.mean, color=color)


class TestLookup:
    @pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
    @pytest.mark.parametrize("k", range(len(FOOTPRINTS)))
    def test_sees_what_brute_force_sees(self, backend, wrap, k):
        scene, points = inner_scene(), around(some_points(), wrap)
        exact = brute_force(scene, wrap, points, FOOTPRINTS[k])
        found = stacked(looked_up(lattice_of(scene.on(backend), wrap), points, FOOTPRINTS[k]))
        error = np.abs(found + scene.background - exact)
        assert error.max() < 0.03
        assert error.mean() < 0.005

    def test_coarser_lattices_agree_with_finer_ones(self, backend):
        """Seen from afar, every level gives the same."""
        scene = inner_scene(count=440, size=(80, 64))
        lattice = lattice_of(scene.on(backend), "repeat")
        assert len(lattice.levels) >= 3
        covariance, points = np.diag([36.0, 30.0]), some_points()
        whole = stacked(looked_up(lattice, points, covariance))
        for number in range(1, 3):
            part = replace(lattice, levels=lattice.levels[:number])
            found = stacked(looked_up(part, points, covariance))
            np.testing.assert_allclose(found, whole, atol=0.02)

    def test_small_footprints_are_not_distant(self, backend):
        lattice = lattice_of(inner_scene().on(backend), "repeat")
        Float = types_of(lattice.values).Float
        for covariance in ([0, 0, 0], [0.5, 0, 100], [50, 49.9, 50]):
            assert not np.array(is_minified(lattice, [Float(c) for c in covariance])).any()


class TestMean:
    @pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
    def test_is_that_of_a_fine_picture(self, backend, wrap):
        scene = inner_scene(7)
        fine = tiled(scene, "repeat", copies=0)[0].mean(axis=(0, 1))
        found = np.array(pyramid_mean(lattice_of(scene.on(backend), wrap))).ravel()
        np.testing.assert_allclose(scene.background + found, fine, atol=0.01)


class TestGradient:
    @pytest.mark.parametrize("wrap", ["mirror", "clamp"])
    @pytest.mark.parametrize("name", ["mean", "factor", "color"])
    def test_is_a_finite_difference(self, backend, wrap, name):
        """Through the lattice to the splats behind it, in float64."""
        points, weight = (
            around(some_points(40), wrap),
            np.random.default_rng(0).normal(size=(40, 3)),
        )

        def loss(gaussians):
            lattice = lattice_of(gaussians, wrap, 9.0)
            rows = looked_up(lattice, points, FOOTPRINTS[4])
            Float = types_of(gaussians.mean).Float
            seen = sum(r * w for r, w in zip(rows, upload_rows(Float, weight.T), strict=True))
            return dr.sum(seen) + pyramid_mean(lattice)[0]

        check_gradient(loss, inner_scene(5, 9), name, backend)


@pytest.mark.parametrize(
    ("size", "count", "levels"),
    [((64, 64), 1400, 4), ((64, 64), 5, 1), ((7, 300), 5, 1), ((64, 32), 200, 2)],
)
def test_there_are_as_many_points_as_the_gaussians_need(backend, size, count, levels):
    """No spacing is below a pixel, and the coarsest level has few points."""
    lattice = lattice_of(random_scene(0, count, size).on(backend), "repeat")
    assert len(lattice.levels) == levels
    for level in lattice.levels:
        assert level.nx * level.dx == pytest.approx(size[0])
        assert level.ny * level.dy == pytest.approx(size[1])
    assert dr.width(lattice.values) == 4 * sum(level.nx * level.ny for level in lattice.levels)


@pytest.mark.parametrize("brightness", [1e-3, 1.0, 1e6])
def test_half_precision_keeps_what_8_bits_show(backend, brightness):
    """Relative to the brightest value, whatever the unit of the light."""
    scene = inner_scene()
    lattice = lattice_of(scene._replace(color=brightness * scene.color).on(backend), "repeat")
    half, points = lattice.halved(), some_points()
    assert dr.itemsize_v(half.values) == 2
    found, expected = (stacked(looked_up(k, points, FOOTPRINTS[4])) for k in (half, lattice))
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())
    means = [np.array(pyramid_mean(k)).ravel() for k in (half, lattice)]
    np.testing.assert_allclose(*means, atol=1e-4 * np.abs(expected).max())


def test_double_precision_stays(backend):
    lattice = lattice_of(inner_scene().on(backend, bits=64), "repeat")
    assert lattice.halved() is lattice


@pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
@pytest.mark.parametrize(("count", "size"), [(40, SIZE), (MANY, SIZE), (9, (1, 8))])
def test_the_finest_level_is_the_filtered_sum(backend, wrap, count, size):
    """At every point, although most are rendered and only the border is looked up."""
    sizes, packed, *rest = arrays_of(random_scene(3, count, size).on(backend), wrap)
    types, level = types_of(packed.values), coarsen.levels_of(*size, count, wrap)[0]
    index = dr.arange(types.UInt, level.columns * level.rows)
    x = (types.Float(index % level.columns) + 0.5 - level.pad) * level.dx
    y = (types.Float(index // level.columns) + 0.5 - level.pad) * level.dy
    blur = [types.Float((coarsen.SAMPLE_DEVIATION * k) ** 2) for k in (level.dx, 0, level.dy)]
    expected = sum_prefiltered(sizes, packed, x, y, blur, types.Bool(True))
    found = np.array(coarsen.build_pyramid(sizes, packed, *rest).values)
    found = found[: 4 * level.columns * level.rows].reshape(-1, 4)[:, : packed.channels]
    np.testing.assert_allclose(found, np.stack([np.array(e) for e in expected], 1), atol=3e-5)

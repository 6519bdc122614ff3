"""Lists in 16 bits: the Gaussians that touch a cell, also of sets that need several bands."""

import drjit as dr
import numpy as np
import pytest

from _helpers.footprints import check_gradient, coordinates, exact_at, some_points, stacked
from _helpers.sets import random_scene
from eigengs_dr.backend.arrays import types_of
from eigengs_dr.raster.binning.lists import build_lists
from eigengs_dr.raster.binning.tiles import Grid
from eigengs_dr.raster.lookup import cells as numbered
from eigengs_dr.raster.lookup.cells import cell_side, list_cells
from eigengs_dr.raster.lookup.points import Packed, invert, sum_at_points, value_terms
from eigengs_dr.raster.lookup.prefilter import sum_prefiltered
from eigengs_dr.raster.lookup.size_classes import classify_by_size
from eigengs_dr.raster.parameters import kernel_radius
from eigengs_dr.raster.render import decode_parameters

BANDED = (64, 64)
"""An image that is higher than its Gaussians."""


@pytest.fixture
def few_numbers(monkeypatch):
    """16 bits that number 25 Gaussians."""
    monkeypatch.setattr(numbered, "MOST", 25)


def small_scene(count=60):
    """Gaussians of some pixels, all over the image."""
    scene = random_scene(2, count, BANDED)
    return scene._replace(factor=np.tile([0.6, 0.1, 0.5], (count, 1)))


def lists_of(gaussians, side, cutoff=3.0):
    level = dr.detach(decode_parameters(gaussians).shape), side
    return list_cells([level], gaussians.width, gaussians.height, kernel_radius(cutoff))


def sums_of(gaussians, points, side=4, cutoff=3.0):
    p, cells = decode_parameters(gaussians), lists_of(gaussians, side, cutoff)
    packed = Packed(cells.pack(p.shape, p.color), gaussians.channels, cutoff)
    types = types_of(gaussians.mean)
    x, y = coordinates(types.Float, points)
    return sum_at_points(cells, packed, x, y, types.Bool(True), value_terms(packed))


@pytest.mark.parametrize("side", [1, 4, 16])
def test_bands_sum_all_gaussians_that_reach_a_point(backend, few_numbers, side):
    scene, points = small_scene(), some_points(400, BANDED)
    assert dr.width(lists_of(scene.on(backend), side).first) > 1
    exact, sure = exact_at(scene, points, 3.0)
    found = stacked(sums_of(scene.on(backend), points, side))
    np.testing.assert_allclose(found[sure], exact[sure], atol=2e-5)


@pytest.mark.parametrize("side", [1, 5, 16])
def test_cells_list_the_gaussians_that_tiles_of_their_size_list(backend, side):
    """In the same order; strips of several cells hang over the image."""
    gaussians = small_scene().on(backend)
    cells, grid = lists_of(gaussians, side), Grid(*BANDED, (side, side))
    shape, radius = dr.detach(decode_parameters(gaussians).shape), kernel_radius(3.0)
    tiles = build_lists(shape, radius, grid, pad=0.5, adjoint=False, ordered=False)
    numbers = cells.runs.numpy().view(np.uint16)
    runs, splat = 4 * cells.levels[0].starts.numpy(), tiles.splat.numpy()
    ends = zip(runs[:-1], runs[1:], tiles.begin.numpy(), tiles.end.numpy(), strict=True)
    for first, last, begin, end in ends:
        listed = numbers[first:last]
        np.testing.assert_array_equal(listed[listed > 0] - 1, splat[begin:end])


@pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
@pytest.mark.parametrize("variance", [0.01, 4.0, 40.0, 300.0])
def test_bands_change_no_filtered_sum(backend, wrap, variance, monkeypatch):
    """Some Gaussians lie outside of the image, where only footprints over its border see them."""
    scene, points, found = small_scene(), some_points(200, BANDED), []
    scene.mean[:6, 1] = BANDED[1] + np.arange(4, 10)
    gaussians = scene.on(backend)
    p, types = decode_parameters(gaussians), types_of(gaussians.mean)
    x, y = coordinates(types.Float, points)
    footprint = [dr.opaque(types.Float, variance * k) for k in (1, 0.3, 0.6)]
    for most in (1000, 59):
        monkeypatch.setattr(numbered, "MOST", most)
        sizes = classify_by_size(dr.detach(p.shape), *BANDED, 3.0, wrap)
        assert (dr.width(sizes.cells.first) > 1) == (most == 59)
        packed = Packed(sizes.cells.pack(*invert(p.shape, p.color)), 3, 3.0, inverted=True)
        found.append(stacked(sum_prefiltered(sizes, packed, x, y, footprint, types.Bool(True))))
    np.testing.assert_allclose(*found, atol=1e-5)


@pytest.mark.parametrize("name", ["mean", "factor", "color"])
def test_the_gradient_of_bands_is_a_finite_difference(backend, few_numbers, name):
    """Also of Gaussians with rows in several bands."""
    points = some_points(100, BANDED)

    def loss(gaussians):
        return dr.sum(sum(dr.square(row) for row in sums_of(gaussians, points, cutoff=9.0)))

    scene = small_scene(30)
    check_gradient(loss, scene._replace(factor=3 * scene.factor), name, backend)


def test_too_many_gaussians_of_one_cell_are_a_mistake(backend, few_numbers):
    scene = small_scene()
    scene.mean[:] = 30.0
    with pytest.raises(ValueError, match="more than 25 Gaussians touch 4 rows of pixels"):
        lists_of(scene.on(backend), 4)


@pytest.mark.parametrize("count", [1, 100, 5_000, 100_000])
def test_there_are_about_as_many_cells_as_gaussians(count):
    cells = 800 * 600 / cell_side(800, 600, count) ** 2
    assert 0.4 * count < cells < 1.6 * count

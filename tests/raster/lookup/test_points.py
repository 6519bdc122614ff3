"""Sums at scattered points: values, slopes and gradients, against float64 without any lists."""

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from _helpers.footprints import check_gradient, coordinates, exact_at, some_points, stacked
from _helpers.sets import SIZE, few, random_scene, scenes
from eigengs_dr.backend.arrays import types_in, types_of, upload_rows
from eigengs_dr.backend.selection import select
from eigengs_dr.raster.lookup.cells import list_cells
from eigengs_dr.raster.lookup.points import (
    Packed,
    fold,
    gradient_terms,
    sum_at_points,
    value_terms,
)
from eigengs_dr.raster.parameters import kernel_radius
from eigengs_dr.raster.render import decode_parameters

POINTS = np.concatenate([np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * SIZE, some_points(396)])
"""Points in the image, its corners among them, shape (points, 2)."""

WIDE = 9.0
"""A cutoff at which a splat's edge is nothing: finite differences may cross it."""


def arrays_of(gaussians, points, cutoff, side=4):
    """Lists, packed parameters, and x and y of points, as lookups take them."""
    p = decode_parameters(gaussians)
    types = types_of(gaussians.mean)
    x, y = coordinates(types.Float, points)
    level, size = (dr.detach(p.shape), side), (gaussians.width, gaussians.height)
    cells = list_cells([level], *size, kernel_radius(cutoff))
    return cells, Packed(cells.pack(p.shape, p.color), gaussians.channels, cutoff), x, y


def look_up(gaussians, points, cutoff, side=4, terms=value_terms, number=1):
    """Rows of sums at points, without the background."""
    cells, packed, x, y = arrays_of(gaussians, points, cutoff, side)
    count, active = number * gaussians.channels, types_of(x).Bool(True)
    return sum_at_points(cells, packed, x, y, active, terms(packed), count)


class TestValues:
    @few
    @given(scene=scenes())
    def test_sums_all_splats_that_reach_a_point(self, backend, scene):
        exact, sure = exact_at(scene, POINTS, 3.0)
        found = stacked(look_up(scene.on(backend), POINTS, 3.0))
        np.testing.assert_allclose(found[sure], exact[sure], atol=2e-5)

    @pytest.mark.parametrize("side", [1, 2, 8, 64])
    def test_does_not_depend_on_the_cells(self, backend, side):
        gaussians = random_scene(1).on(backend)
        np.testing.assert_allclose(
            stacked(look_up(gaussians, POINTS, 3.0, side)),
            stacked(look_up(gaussians, POINTS, 3.0)),
            atol=1e-6,
        )

    def test_costs_what_overlaps_and_not_what_there_is(self, backend):
        """64 times the splats on 64 times the area: a point has hardly more of them to look at."""
        lengths = []
        for count, size in ((50, (64, 64)), (3200, (512, 512))):
            rng = np.random.default_rng(0)
            scene = random_scene(0, count, size)._replace(
                mean=rng.uniform(0, 1, (count, 2)) * size, factor=np.tile([0.3, 0, 0.3], (count, 1))
            )
            cells, *_ = arrays_of(scene.on(backend), some_points(size=size), 3)
            lengths.append(np.mean(np.diff(np.array(cells.levels[0].starts, int))))
        assert lengths[1] < 1.4 * lengths[0]  # fewer cells lie at the border


class TestDerivatives:
    def test_slopes_are_finite_differences(self, backend):
        scene, points, step = random_scene(6), POINTS, 1e-5
        rows = stacked(
            look_up(scene.on(backend, bits=64), points, WIDE, terms=gradient_terms, number=3)
        )
        for k, direction in ((1, [step, 0]), (2, [0, step])):
            up, down = (exact_at(scene, points + s * np.array(direction), WIDE)[0] for s in (1, -1))
            np.testing.assert_allclose(rows[:, k::3], (up - down) / (2 * step), atol=1e-8)

    @pytest.mark.parametrize("name", ["mean", "factor", "color"])
    def test_gradient_is_a_finite_difference(self, backend, name):
        weight = np.random.default_rng(0).normal(size=(len(POINTS), 3))

        def loss(gaussians):
            rows = look_up(gaussians, POINTS, WIDE)
            Float = types_of(gaussians.mean).Float
            return dr.sum(
                sum(r * w for r, w in zip(rows, upload_rows(Float, weight.T), strict=True))
            )

        check_gradient(loss, random_scene(7, count=7), name, backend)

    def test_gradient_reaches_the_point(self, backend):
        """The loop hands on derivatives of where it is evaluated, which geometry may have."""
        gaussians = random_scene(8).on(backend, bits=64)
        cells, packed, x, y = arrays_of(gaussians, POINTS, WIDE)
        dr.enable_grad(x, y)
        sums = sum_at_points(cells, packed, x, y, types_of(x).Bool(True), value_terms(packed))
        dr.backward(dr.sum(sums[0]))
        rows = look_up(gaussians, POINTS, WIDE, terms=gradient_terms, number=3)
        np.testing.assert_allclose(np.array(dr.grad(x)), np.array(rows[1]), atol=1e-9)
        np.testing.assert_allclose(np.array(dr.grad(y)), np.array(rows[2]), atol=1e-9)


@few
@given(x=st.floats(width=32), wrap=st.sampled_from(["repeat", "mirror", "clamp"]))
def test_no_coordinate_leaves_the_image(backend, x, wrap):
    """What is not finite becomes the first place."""
    found, slope = (np.array(v) for v in fold(types_in(select(backend)).Float([x]), 10, wrap))
    assert 0 <= found[0] <= 10
    assert np.isfinite(x) or found[0] == (0.5 if wrap == "clamp" else 0)
    assert slope[0] in (-1, 0, 1)

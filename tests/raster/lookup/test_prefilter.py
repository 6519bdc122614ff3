"""Sums seen through a footprint, against brute force; its bounds, and the error function."""

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import erf

from _helpers.footprints import (
    CUTOFF,
    around,
    brute_force,
    check_gradient,
    coordinates,
    exact_at,
    matrices,
    some_points,
    stacked,
)
from _helpers.sets import SIZE, covariances, few, random_scene
from eigengs_dr.backend.arrays import types_in, types_of, upload_rows
from eigengs_dr.backend.selection import select
from eigengs_dr.raster.lookup.footprint import MAX_FOOTPRINT, bound_covariance, quick_erf
from eigengs_dr.raster.lookup.points import Packed, invert
from eigengs_dr.raster.lookup.prefilter import sum_prefiltered
from eigengs_dr.raster.lookup.size_classes import classify_by_size
from eigengs_dr.raster.render import decode_parameters

FOOTPRINTS = [
    np.diag([0.3, 0.3]),
    np.diag([4.0, 4.0]),
    np.array([[9.0, 4.0], [4.0, 3.0]]),
    np.diag([60.0, 0.5]),
    np.diag((MAX_FOOTPRINT * np.array(SIZE)) ** 2),
]
"""Covariances in pixels squared: small, round, leaning, a long one, and the largest there is."""


def arguments(gaussians, wrap, points, covariance, cutoff=CUTOFF):
    """What `sum_prefiltered` takes."""
    p = decode_parameters(gaussians)
    types = types_of(gaussians.mean)
    shape = [dr.detach(r) for r in p.shape]
    sizes = classify_by_size(shape, gaussians.width, gaussians.height, cutoff, wrap)
    rows = sizes.cells.pack(*invert(p.shape, p.color))
    packed = Packed(rows, gaussians.channels, cutoff, inverted=True)
    x, y = coordinates(types.Float, points)
    entries = (float(covariance[k]) for k in ((0, 0), (0, 1), (1, 1)))
    footprint = [dr.opaque(types.Float, entry) for entry in entries]
    return sizes, packed, x, y, footprint, types.Bool(True)


def filtered(*given):
    """Rows of what `sum_prefiltered` gives, without the background."""
    return sum_prefiltered(*arguments(*given))


class TestSumFiltered:
    @pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
    @pytest.mark.parametrize("k", range(len(FOOTPRINTS)))
    def test_sees_what_brute_force_sees(self, backend, wrap, k):
        """Exact but for the tails of footprints, and near corners: see `inside_share`."""
        scene, points = random_scene(1, 60), around(some_points(), wrap)
        scene = scene._replace(mean=0.2 * np.array(SIZE) + 0.6 * scene.mean)
        corner = np.abs(points - np.round(points / SIZE) * SIZE).max(axis=1) < 3
        exact = brute_force(scene, wrap, points, FOOTPRINTS[k])
        found = stacked(filtered(scene.on(backend), wrap, points, FOOTPRINTS[k]))
        error = np.abs(found + scene.background - exact)
        assert np.abs(exact - exact.mean(axis=0)).max() > 0.05
        assert error[~corner].max() < 0.03
        assert error.mean() < 0.005

    def test_splats_outside_of_the_image_are_seen_over_its_border(self, backend):
        """Up to the last cells of the table; a footprint next to nothing sees the sum itself."""
        scene, rng = random_scene(6, 60), np.random.default_rng(1)
        mean = scene.mean.copy()
        mean[:30, 0] = SIZE[0] + rng.uniform(1, 4, 30)
        mean[30:, 1] = SIZE[1] + rng.uniform(1, 4, 30)
        scene = scene._replace(mean=mean, factor=np.tile([0.5, 0.0, 0.5], (60, 1)))
        points = some_points()
        points[:30, 0], points[30:, 1] = SIZE[0] - 0.05, SIZE[1] - 0.05
        exact, sure = exact_at(scene, points, 2.0, margin=0.01)
        near = np.diag([0.01, 0.01])
        found = stacked(filtered(scene.on(backend), "mirror", points, near, 2.0))
        assert sure.sum() > 30
        assert np.abs(exact[sure]).max() > 0.1
        np.testing.assert_allclose(found[sure], exact[sure], atol=0.05 * np.abs(exact).max())

    @pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
    def test_without_a_footprint_it_is_the_sum(self, backend, wrap):
        scene, points = random_scene(3), around(some_points(), wrap)
        inside = np.clip(points, 0.5, np.array(SIZE) - 0.5) if wrap == "clamp" else points
        exact, sure = exact_at(scene, inside, CUTOFF)
        found = stacked(filtered(scene.on(backend), wrap, points, np.zeros((2, 2))))
        np.testing.assert_allclose(found[sure], exact[sure], atol=1e-5)

    @pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
    @pytest.mark.parametrize("footprint", [(0.3, 0.3, 0.0), (9, 3, 4), (30, 30, 27), (30, 30, -27)])
    def test_nothing_is_left_out_far_from_borders(self, backend, wrap, footprint):
        """Gaussians that differ a thousandfold in size, and long, turned footprints."""
        size, rng = (128, 96), np.random.default_rng(4)
        factor = np.tile([1.2, 0.3, 0.9], (400, 1)) * 1000 ** rng.uniform(-0.1, 0.9, (400, 1))
        mean = rng.uniform(0.3, 0.7, (400, 2)) * size
        scene = random_scene(4, 400, size)._replace(mean=mean, factor=factor)
        xx, yy, xy = footprint
        covariance = np.array([[xx, xy], [xy, yy]])
        points = some_points(60, size) * 0.2 + 0.4 * np.array(size)
        spread = matrices(*scene.factor.T) + covariance
        delta = points[:, None] - scene.mean
        q = np.einsum("pni,nij,pnj->pn", delta, np.linalg.inv(spread), delta)
        scale = np.sqrt(np.linalg.det(spread - covariance) / np.linalg.det(spread))
        exact = (np.where(q <= 9, np.exp(-0.5 * q), 0) * scale) @ scene.color
        found = stacked(filtered(scene.on(backend), wrap, points, covariance, 3.0))
        np.testing.assert_allclose(found, exact, atol=2e-3)

    @pytest.mark.parametrize("wrap", ["mirror", "clamp"])
    @pytest.mark.parametrize("k", [1, 3])
    @pytest.mark.parametrize("name", ["mean", "factor", "color"])
    def test_gradient_is_a_finite_difference(self, backend, wrap, k, name):
        """Points inside and at borders, so that both ways of summing are seen; in float64."""
        points, weight = (
            around(some_points(40), wrap),
            np.random.default_rng(0).normal(size=(40, 3)),
        )

        def loss(gaussians):
            rows = filtered(gaussians, wrap, points, FOOTPRINTS[k], 9.0)
            Float = types_of(gaussians.mean).Float
            return dr.sum(
                sum(r * w for r, w in zip(rows, upload_rows(Float, weight.T), strict=True))
            )

        check_gradient(loss, random_scene(5, 9), name, backend)

    def test_a_set_that_is_nowhere_gives_nothing(self, backend):
        scene = random_scene(6)
        scene = scene._replace(mean=scene.mean + 1e6)
        rows = stacked(filtered(scene.on(backend), "repeat", some_points(), FOOTPRINTS[1]))
        np.testing.assert_array_equal(rows, 0)


class TestBoundedCovariance:
    def bounded(self, backend, metrics):
        Float = types_in(select(backend)).Float
        rows = [Float(np.asarray(m, np.float32)) for m in np.array(metrics).T.copy()]
        covariance, blind = bound_covariance(rows)
        return np.stack([np.array(c) for c in covariance], 1), np.array(blind)

    @few
    @given(
        long=st.floats(0.001, 100),
        short=st.floats(0.001, 100),
        angle=st.floats(0, 3),
    )
    def test_inverts_and_shortens(self, backend, long, short, angle):
        axes = covariances(np.array([[1.0, 0.0]]), np.array([angle]))[0]
        other = np.eye(2) - axes
        metric = axes / long**2 + other / short**2
        expected = axes * min(long, MAX_FOOTPRINT) ** 2 + other * min(short, MAX_FOOTPRINT) ** 2
        found, blind = self.bounded(backend, [[metric[0, 0], metric[0, 1], metric[1, 1]]])
        if min(long, short) > MAX_FOOTPRINT * 1.001:
            assert blind[0]
        elif min(long, short) < MAX_FOOTPRINT / 1.001:
            assert not blind[0]
            keys = ((0, 0), (0, 1), (1, 1))
            np.testing.assert_allclose(found[0], [expected[k] for k in keys], atol=2e-3)

    def test_what_is_not_finite_is_blind(self, backend):
        found, blind = self.bounded(
            backend, [[np.nan, 0, 1], [np.inf, 0, np.inf], [0, 0, 0], [1, np.nan, 1]]
        )
        assert blind.all()
        assert np.isfinite(found).all()


def test_quick_erf_is_close(backend):
    x = np.linspace(-6, 6, 2001, dtype=np.float32)
    found = np.array(quick_erf(types_in(select(backend)).Float(x)))
    np.testing.assert_allclose(found, erf(x), atol=0.0055)
    assert np.abs(found).max() <= 1 + 1e-6

"""Sums seen through a footprint, against brute force: a fine picture, its copies, a weighed sum."""

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import SIZE, covariances, few, random_scene
from scipy.special import erf

from eigengs_dr.backend.arrays import types_in, types_of
from eigengs_dr.backend.selection import select
from eigengs_dr.raster.evaluate import widen
from eigengs_dr.raster.layout import pack_parameters
from eigengs_dr.raster.lookup.footprint import MAX_FOOTPRINT, bound_covariance, quick_erf
from eigengs_dr.raster.lookup.prefilter import sum_prefiltered
from eigengs_dr.raster.lookup.size_classes import classify_by_size
from eigengs_dr.raster.parameters import EXP2_SCALE, NUM_SHAPE_PARAMS
from eigengs_dr.raster.reference import render_exact
from eigengs_dr.raster.render import decode_parameters

CUTOFF = 5.0
FINE = 4
"""Samples a pixel of the pictures that brute force sums, along each axis."""

FOOTPRINTS = [
    np.diag([0.3, 0.3]),
    np.diag([4.0, 4.0]),
    np.array([[9.0, 4.0], [4.0, 3.0]]),
    np.diag([60.0, 0.5]),
    np.diag((MAX_FOOTPRINT * np.array(SIZE)) ** 2),
]
"""Covariances in pixels squared: small, round, leaning, a long one, and the largest there is."""


def some_points(count=60, size=SIZE, seed=3):
    points = np.random.default_rng(seed).uniform(0, 1, (count, 2)) * size
    return points.astype(np.float32).astype(np.float64)


def tiled(scene, wrap, copies=3):
    """The picture and copies of it on every side, at `FINE` samples a pixel."""
    image = render_exact(
        scene.mean * FINE,
        scene.factor / FINE,
        scene.color,
        scene.background,
        *(side * FINE for side in scene.size),
        CUTOFF,
    )
    for axis in (0, 1):
        flipped = np.flip(image, axis) if wrap == "mirror" else image
        parts = [flipped if k % 2 else image for k in range(-copies, copies + 1)]
        image = np.concatenate(parts, axis)
    return image, copies


def brute_force(scene, wrap, points, covariance):
    """What a footprint sees at points, shape (points, C)."""
    image, copies = tiled(scene, wrap)
    x = (np.arange(image.shape[1]) + 0.5) / FINE - copies * scene.size[0]
    y = (np.arange(image.shape[0]) + 0.5) / FINE - copies * scene.size[1]
    (a, b), (_, c) = np.linalg.inv(covariance)
    seen = []
    for px, py in points:
        dx, dy = x - px, (y - py)[:, None]
        weight = np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
        seen.append(np.tensordot(weight, image, 2) / weight.sum())
    return np.array(seen)


def filtered(gaussians, wrap, points, covariance, cutoff=CUTOFF):
    """Rows of what `sum_prefiltered` gives, without the background."""
    p = decode_parameters(gaussians)
    rows = [*p.shape, *p.color]
    types = types_of(gaussians.mean)
    shape = [dr.detach(r) for r in rows[:NUM_SHAPE_PARAMS]]
    sizes = classify_by_size(shape, gaussians.width, gaussians.height, cutoff, wrap)
    x, y = (types.Float(np.ascontiguousarray(points[:, k])) for k in (0, 1))
    footprint = [types.Float(float(covariance[k])) for k in ((0, 0), (0, 1), (1, 1))]
    number = NUM_SHAPE_PARAMS + gaussians.channels
    return sum_prefiltered(
        sizes, pack_parameters(rows), number, x, y, footprint, types.Bool(True), cutoff
    )


def stacked(rows):
    return np.stack([np.array(r) for r in rows], axis=1)


class TestSumFiltered:
    @pytest.mark.parametrize("wrap", ["repeat", "mirror"])
    @pytest.mark.parametrize("k", range(len(FOOTPRINTS)))
    def test_sees_what_brute_force_sees(self, backend, wrap, k):
        """Exact but for the tails of footprints, and near corners: see `share`."""
        scene, points = random_scene(1, 60), some_points()
        scene = scene._replace(mean=0.2 * np.array(SIZE) + 0.6 * scene.mean)
        corner = np.abs(points - np.round(points / SIZE) * SIZE).max(axis=1) < 3
        exact = brute_force(scene, wrap, points, FOOTPRINTS[k])
        found = stacked(filtered(scene.on(backend), wrap, points, FOOTPRINTS[k]))
        error = np.abs(found + scene.background - exact)
        assert np.abs(exact - exact.mean(axis=0)).max() > 0.05
        assert error[~corner].max() < 0.03
        assert error.mean() < 0.005

    @pytest.mark.parametrize("lean", [1, -1])
    def test_lists_turn_with_the_mirror(self, backend, lean):
        """Small splats, seen over a border through a footprint that is long, thin and slanted."""
        scene = random_scene(5, 200)
        scene = scene._replace(factor=np.tile([1.2, 0.0, 1.2], (200, 1)))
        covariance = np.array([[9.0, 8.7 * lean], [8.7 * lean, 9.0]])
        points = some_points()
        points[:, 0] = np.where(points[:, 0] < SIZE[0] / 2, 0.5, SIZE[0] - 0.5)
        points[:, 1] = 8 + (points[:, 1] - 8) % (SIZE[1] - 16)
        exact = brute_force(scene, "mirror", points, covariance)
        found = stacked(filtered(scene.on(backend), "mirror", points, covariance))
        error = np.abs(found + scene.background - exact)
        assert np.abs(exact - exact.mean(axis=0)).max() > 0.05
        assert error.mean() < 0.005
        assert error.max() < 0.03

    def test_splats_outside_of_the_image_are_seen_over_its_border(self, backend):
        """Up to the last cells of the table; a footprint next to nothing sees the sum itself."""
        scene, rng = random_scene(6, 60), np.random.default_rng(1)
        mean = scene.mean.copy()
        mean[:30, 0] = SIZE[0] + rng.uniform(1, 4, 30)
        mean[30:, 1] = SIZE[1] + rng.uniform(1, 4, 30)
        scene = scene._replace(mean=mean, factor=np.tile([0.5, 0.0, 0.5], (60, 1)))
        points = some_points()
        points[:30, 0], points[30:, 1] = SIZE[0] - 0.05, SIZE[1] - 0.05
        delta = points[:, None] - scene.mean
        distance = 0.5 * np.hypot(delta[..., 0], delta[..., 1])
        exact = np.where(distance <= 2, np.exp(-0.5 * distance**2), 0) @ scene.color
        sure = (np.abs(distance - 2) > 0.02).all(axis=1)
        near = np.diag([0.01, 0.01])
        found = stacked(filtered(scene.on(backend), "mirror", points, near, cutoff=2.0))
        assert sure.sum() > 30
        assert np.abs(exact[sure]).max() > 0.1
        np.testing.assert_allclose(found[sure], exact[sure], atol=0.05 * np.abs(exact).max())

    def test_far_from_borders_it_is_exact(self, backend):
        scene = random_scene(2)
        scene = scene._replace(mean=scene.mean % np.array(SIZE) * 0.2 + 0.4 * np.array(SIZE))
        points = some_points() * 0.2 + 0.4 * np.array(SIZE)
        covariance = np.array([[0.6, 0.2], [0.2, 0.5]])
        exact = brute_force(scene, "repeat", points, covariance)
        found = stacked(filtered(scene.on(backend), "repeat", points, covariance))
        np.testing.assert_allclose(found + scene.background, exact, atol=2e-3)

    @pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
    def test_without_a_footprint_it_is_the_sum(self, backend, wrap):
        scene, points = random_scene(3), some_points()
        delta = points[:, None] - scene.mean
        a, b, c = scene.factor.T
        distance = np.hypot(a * delta[..., 0] + b * delta[..., 1], c * delta[..., 1])
        exact = np.where(distance <= CUTOFF, np.exp(-0.5 * distance**2), 0) @ scene.color
        found = stacked(filtered(scene.on(backend), wrap, points, np.zeros((2, 2))))
        np.testing.assert_allclose(found, exact, atol=1e-5)

    def test_lists_leave_nothing_out(self, backend):
        """Sets whose splats differ a thousandfold in size, seen through footprints of any size."""
        rng = np.random.default_rng(0)
        scene = random_scene(4, 80)
        sigma = 0.1 * 1000 ** rng.uniform(0, 1, 80)
        variances = np.stack([sigma, sigma * 3], axis=1) ** 2
        shapes = covariances(variances, rng.uniform(0, np.pi, 80))
        factor = np.linalg.cholesky(np.linalg.inv(shapes))
        scene = scene._replace(
            factor=np.stack([factor[:, 0, 0], factor[:, 1, 0], factor[:, 1, 1]], axis=1)
        )
        types = types_in(select(backend))
        for covariance in FOOTPRINTS[:3]:
            points = some_points() * 0.3 + 0.35 * np.array(SIZE)
            total = 0
            for n in range(80):
                one = scene.permuted([n]).on(backend)
                p = decode_parameters(one)
                rows = [*p.shape, *p.color]
                scaled = [
                    types.Float(covariance[k] / EXP2_SCALE**2) for k in ((0, 0), (0, 1), (1, 1))
                ]
                (mx, my, a, b, c), amplitude = widen(rows[:NUM_SHAPE_PARAMS], scaled)
                a, b, c = (np.array(v)[0] / EXP2_SCALE for v in (a, b, c))
                dx, dy = (points[:, k] - np.array(v)[0] for k, v in ((0, mx), (1, my)))
                distance = np.hypot(a * dx + b * dy, c * dy)
                weight = np.where(distance <= 3, np.exp(-0.5 * distance**2), 0)
                total = total + (weight * np.array(amplitude)[0])[:, None] * scene.color[n]
            found = stacked(filtered(scene.on(backend), "clamp", points, covariance, 3.0))
            # Where footprints reach over a border a share is missing: more than any lost splat.
            assert np.abs(found - total).max() < 0.1 * np.abs(scene.color).max()

    @pytest.mark.parametrize("sign", [1, -1])
    def test_runs_of_cells_follow_a_leaning_footprint(self, backend, sign):
        """Far from borders every splat that a long, turned footprint reaches is found."""
        size = (128, 96)
        rng = np.random.default_rng(4)
        scene = random_scene(4, 400, size)
        scene = scene._replace(
            mean=rng.uniform(0.3, 0.7, (400, 2)) * size, factor=np.tile([1.2, 0.3, 0.9], (400, 1))
        )
        covariance = np.array([[30.0, 27.0 * sign], [27.0 * sign, 30.0]])
        points = some_points(60, size) * 0.2 + 0.4 * np.array(size)
        spread = matrices(*scene.factor.T) + covariance
        delta = points[:, None] - scene.mean
        q = np.einsum("pni,nij,pnj->pn", delta, np.linalg.inv(spread), delta)
        scale = np.sqrt(np.linalg.det(spread - covariance) / np.linalg.det(spread))
        exact = (np.where(q <= 9, np.exp(-0.5 * q), 0) * scale) @ scene.color
        for wrap in ("repeat", "mirror"):
            found = stacked(filtered(scene.on(backend), wrap, points, covariance, 3.0))
            np.testing.assert_allclose(found, exact, atol=2e-3)

    @pytest.mark.parametrize("k", [1, 3])
    def test_gradients_are_finite_differences(self, backend, k):
        """Points inside and at borders, so that both ways of summing are seen; in float64."""
        scene, points = random_scene(5, 9), some_points(40)
        weight = np.random.default_rng(0).normal(size=(40, 3))

        def loss(gaussians):
            rows = filtered(gaussians, "mirror", points, FOOTPRINTS[k], 9.0)
            Float = types_of(gaussians.mean).Float
            return dr.sum(sum(r * Float(w) for r, w in zip(rows, weight.T.copy(), strict=True)))

        gaussians = scene.on(backend, bits=64)
        dr.enable_grad(gaussians.mean, gaussians.factor, gaussians.color)
        dr.backward(loss(gaussians))
        for name in ("mean", "factor", "color"):
            found = np.array(dr.grad(getattr(gaussians, name))).T
            direction = np.random.default_rng(1).normal(size=found.shape)
            moved = [
                scene._replace(**{name: getattr(scene, name) + s * 1e-5 * direction})
                for s in (1, -1)
            ]
            up, down = (float(loss(m.on(backend, bits=64))[0]) for m in moved)
            expected = (up - down) / 2e-5
            assert abs(expected) > 1e-3
            assert (found * direction).sum() == pytest.approx(expected, rel=1e-4, abs=1e-6)

    def test_a_set_that_is_nowhere_gives_nothing(self, backend):
        scene = random_scene(6)
        scene = scene._replace(mean=scene.mean + 1e6)
        rows = stacked(filtered(scene.on(backend), "repeat", some_points(), FOOTPRINTS[1]))
        np.testing.assert_array_equal(rows, 0)


class TestWiden:
    @few
    @given(seed=st.integers(0, 1000))
    def test_covariances_add_and_the_integral_stays(self, backend, seed):
        rng = np.random.default_rng(seed)
        scene = random_scene(seed)
        spread = covariances(rng.uniform(0, 30, (1, 2)), rng.uniform(0, np.pi, 1))[0]
        p = decode_parameters(scene.on(backend, bits=64))
        rows = [*p.shape, *p.color]
        Float = types_of(rows[0]).Float
        footprint = [Float(spread[k] / EXP2_SCALE**2) for k in ((0, 0), (0, 1), (1, 1))]
        (_, _, a, b, c), amplitude = widen(rows[:NUM_SHAPE_PARAMS], footprint)
        a, b, c = (np.array(v) / EXP2_SCALE for v in (a, b, c))
        before, after = matrices(*scene.factor.T), matrices(a, b, c)
        np.testing.assert_allclose(after, before + spread, rtol=1e-9, atol=1e-9)
        integrals_before, integrals_after = (np.sqrt(np.linalg.det(m)) for m in (before, after))
        np.testing.assert_allclose(np.array(amplitude) * integrals_after, integrals_before)

    @pytest.mark.parametrize("spread", [(0, 0, 0), (0.05, 0.01, 0.08), (1, 0.3, 2)])
    def test_needles_keep_their_digits(self, backend, spread):
        """Lengths of up to 1,000 times the width, at any angle, in single precision."""
        rng = np.random.default_rng(0)
        a, c = np.exp(rng.uniform(np.log(1 / 2048), np.log(4), (2, 10_000)))
        b = rng.uniform(-4, 4, 10_000)
        shape = [np.zeros(10_000), np.zeros(10_000), a, b, c]
        found = {}
        for bits in ("", "64"):
            Float = getattr(select(backend), "Float" + bits)
            rows = [Float(np.asarray(v, np.float32)) for v in shape]
            (*_, a1, b1, c1), amplitude = widen(rows, [Float(v) for v in spread])
            found[bits] = [np.array(v) for v in (a1, b1, c1, amplitude)]
        for single, double in zip(found[""], found["64"], strict=True):
            np.testing.assert_allclose(single, double, rtol=1e-3, atol=1e-6)


def matrices(a, b, c):
    """Covariances of the factors ``[[a, b], [0, c]]``, shape (N, 2, 2)."""
    factor = np.zeros((len(a), 2, 2))
    factor[:, 0, 0], factor[:, 0, 1], factor[:, 1, 1] = a, b, c
    return np.linalg.inv(np.swapaxes(factor, 1, 2) @ factor)


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

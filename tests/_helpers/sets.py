"""Sets of splats that tests share: drawn at random or by hypothesis.

All numbers are rounded to float32, so that what is computed in float64 has the same input."""

from typing import NamedTuple

import drjit as dr
import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from _helpers.arrays import upload_rows
from _helpers.reference import render_exact
from eigengs_dr import Gaussians

SIZE = (22, 17)
"""Width and height: no multiples of a tile. The same for all tests, so that kernels are
compiled once."""

COUNT = 24
"""Number of splats, for the same reason."""

SMOOTH = 6.0
"""A cutoff whose edge, exp(-18), is below rounding: invariants hold at every pixel."""

few = settings(
    max_examples=10,
    deadline=None,  # the first example compiles kernels
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
"""Settings of the tests that hypothesis drives: the values differ, the kernels do not."""


class Scene(NamedTuple):
    """N splats on an image: what `Gaussians` holds, in float64."""

    mean: np.ndarray
    factor: np.ndarray
    color: np.ndarray
    background: np.ndarray
    size: tuple[int, int] = SIZE

    def on(self, backend, bits=32, space="data"):
        """Upload to a backend, in single or double precision."""
        module, suffix = getattr(dr, backend).ad, "64" if bits == 64 else ""
        Float = getattr(module, "Float" + suffix)

        def rows(kind, array):
            return getattr(module, kind + suffix)(upload_rows(Float, np.atleast_2d(array).T))

        return Gaussians(
            mean=rows("Array2f", self.mean),
            factor=rows("Array3f", self.factor),
            color=rows("ArrayXf", self.color),
            background=rows("ArrayXf", self.background),
            width=self.size[0],
            height=self.size[1],
            space=space,
        )

    def exact(self, cutoff=np.inf):
        """Sum over all pairs of splats and pixels in float64, shape (H, W, C)."""
        return render_exact(*self[:4], *self.size, cutoff)

    def at(self, size, filter=True):
        """The scene of a picture of another size.

        Along axes that shrink by k it is averaged: each covariance grows by that of k pixels in a
        row, and the colour keeps its integral.
        """
        scale = np.divide(size, self.size)
        lower = np.zeros((len(self.mean), 2, 2))
        lower[:, 0, 0], lower[:, 1, 0], lower[:, 1, 1] = self.factor.T
        covariance = np.linalg.inv(lower @ np.swapaxes(lower, 1, 2))
        spread = np.diag(np.maximum(scale**-2.0 - 1, 0) / 12) * filter
        wide = covariance + spread
        amplitude = np.sqrt(np.linalg.det(covariance) / np.linalg.det(wide))
        return Scene(
            self.mean * scale,
            factors_of(wide) / scale[[0, 1, 1]],
            self.color * amplitude[:, None],
            self.background,
            tuple(size),
        )

    def distances(self):
        """``|F (x - mean)|`` of all splats at all pixels, shape (N, H, W)."""
        return distances(self.mean, self.factor, self.size)

    def off_edge(self, cutoff, margin=1e-4):
        """Pixels, shape (H, W), so far from the edges of all cutoffs that rounding decides none."""
        return (np.abs(self.distances() / cutoff - 1) > margin).all(axis=0)

    def permuted(self, order):
        """The same splats in another order, or some of them."""
        return self._replace(
            mean=self.mean[order], factor=self.factor[order], color=self.color[order]
        )


def distances(mean, factor, size):
    """``|F (x - mean)|`` at all pixel centres, shape (N, H, W)."""
    x, y = np.arange(size[0]) + 0.5, np.arange(size[1])[:, None] + 0.5
    mean, factor = np.asarray(mean, np.float64), np.asarray(factor, np.float64)
    mx, my = (v[:, None, None] for v in mean.T)
    a, b, c = (v[:, None, None] for v in factor.T)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.hypot(a * (x - mx) + b * (y - my), c * (y - my))


def covariances(variances, angles):
    """Covariances with the given variances along two axes turned by the angles, shape (N, 2, 2)."""
    cos, sin = np.cos(angles), np.sin(angles)
    axes = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    return np.einsum("nij,nj,nkj->nik", axes, variances, axes)


def factors_of(covariance):
    """a, b, c of ``F = [[a, b], [0, c]]`` with ``F^T F`` the inverse, by Cholesky's factor."""
    lower = np.linalg.cholesky(np.linalg.inv(covariance))
    return np.stack([lower[:, 0, 0], lower[:, 1, 0], lower[:, 1, 1]], axis=1)


def scene_of(unit, size=SIZE):
    """Map numbers in [0, 1], shape (N, 5 + C), to splats in and around an image.

    Standard deviations are 0.4 to 4.8 pixels times a stretch of up to 2, colours in [-1, 1].
    """
    mean = (1.4 * unit[:, :2] - 0.2) * size
    sigma, stretch = 0.4 * 12 ** unit[:, 2], 2 ** (2 * unit[:, 3] - 1)
    variances = np.stack([sigma * stretch, sigma / stretch], axis=1) ** 2
    color = 2 * unit[:, 5:] - 1
    background = np.linspace(0.1, 0.4, color.shape[1])
    arrays = mean, factors_of(covariances(variances, np.pi * unit[:, 4])), color, background
    return Scene(*(a.astype(np.float32).astype(np.float64) for a in arrays), size)


def random_scene(seed=0, count=COUNT, size=SIZE, channels=3):
    """A scene drawn from a seed."""
    return scene_of(np.random.default_rng(seed).uniform(0, 1, (count, 5 + channels)), size)


def scenes(count=COUNT, size=SIZE, channels=3):
    """Strategy for scenes of one size: their values differ."""
    unit = hnp.arrays(np.float64, (count, 5 + channels), elements=st.floats(0, 1, width=32))
    return unit.map(lambda values: scene_of(values, size))


NAMES = ("mean", "factor", "color", "background")
"""Parameters of a set."""


def arrays_of(scene):
    """Parameters of a scene, by name."""
    return {name: getattr(scene, name) for name in NAMES}


def check_equal(gaussians, arrays):
    """Check that a set holds these arrays, rounded to its precision."""
    for name, found in gaussians.to_arrays().items():
        np.testing.assert_array_equal(found, np.asarray(arrays[name], found.dtype), err_msg=name)


def bound(scene, rounding):
    """What rounding may do at a pixel: relative to the sum of what is added there, (H, W, C)."""
    magnitudes = scene._replace(color=np.abs(scene.color), background=np.abs(scene.background))
    return rounding * (1e-3 + magnitudes.exact())

"""Sums seen through a footprint, by brute force."""

import drjit as dr
import numpy as np
import pytest

from _helpers.arrays import upload_rows
from _helpers.reference import render_exact
from _helpers.sets import SIZE

CUTOFF = 5.0
FINE = 3
"""Samples a pixel of the pictures that brute force sums, along each axis."""


def some_points(count=60, size=SIZE, seed=3):
    """Random points in an image, rounded to float32, shape (count, 2)."""
    points = np.random.default_rng(seed).uniform(0, 1, (count, 2)) * size
    return points.astype(np.float32).astype(np.float64)


def coordinates(Float, points):
    """x and y of points, shape (count, 2); memory of NumPy may be unaligned: another kernel."""
    return upload_rows(Float, points.T)


def around(points, wrap, size=SIZE):
    """Points of a clamped image also outside of it, up to its own size."""
    return points * 3 - size if wrap == "clamp" else points


def exact_at(scene, points, cutoff, margin=1e-4):
    """The sum in float64 without background, (points, C), and which points are off all edges."""
    delta = points[:, None] - scene.mean
    a, b, c = scene.factor.T
    distance = np.hypot(a * delta[..., 0] + b * delta[..., 1], c * delta[..., 1])
    weight = np.where(distance <= cutoff, np.exp(-0.5 * distance**2), 0)
    off_edge = (np.abs(distance / cutoff - 1) > margin).all(axis=1)
    return weight @ scene.color, off_edge


def check_gradient(loss, scene, backend):
    """Check the gradient of ``loss(gaussians)`` in float64 along random directions."""
    gaussians, names = scene.on(backend, bits=64), ("mean", "factor", "color")
    for name in names:
        dr.enable_grad(getattr(gaussians, name))
    dr.backward(loss(gaussians))
    for name in names:
        found = np.array(dr.grad(getattr(gaussians, name))).T
        direction = np.random.default_rng(1).normal(size=found.shape)
        up, down = (
            np.array(loss(scene._replace(**{name: moved}).on(backend, bits=64))).item()
            for moved in (getattr(scene, name) + step * direction for step in (1e-5, -1e-5))
        )
        expected = (up - down) / 2e-5
        assert abs(expected) > 1e-3, name
        assert (found * direction).sum() == pytest.approx(expected, rel=1e-4, abs=1e-6), name


def tiled(scene, wrap, copies=3):
    """The picture and copies of it on every side, at `FINE` samples per pixel.

    A clamped one has the values of the outermost centres of pixels beyond them.
    """
    if wrap == "clamp":
        axes = [np.clip((np.arange(n * FINE) + 0.5) / FINE, 0.5, n - 0.5) for n in scene.size]
        points = np.stack(np.meshgrid(*axes), axis=2)
        image = exact_at(scene, points.reshape(-1, 2), CUTOFF)[0] + scene.background
        image = image.reshape(*points.shape[:2], -1)
        more = [(copies * n * FINE,) * 2 for n in scene.size[::-1]]
        return np.pad(image, [*more, (0, 0)], mode="edge"), copies
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
    """What a footprint sees at points, shape (points, C).

    Up to 7 deviations: beyond lies less than 1e-10 of the weight.
    """
    image, copies = tiled(scene, wrap)
    planes = np.ascontiguousarray(np.moveaxis(image, 2, 0))
    x = (np.arange(image.shape[1]) + 0.5) / FINE - copies * scene.size[0]
    y = (np.arange(image.shape[0]) + 0.5) / FINE - copies * scene.size[1]
    (a, b), (_, c) = np.linalg.inv(covariance)
    reach_x, reach_y = 7 * np.sqrt(np.diag(covariance))
    seen = []
    for px, py in points:
        columns = slice(*np.searchsorted(x, (px - reach_x, px + reach_x)))
        rows = slice(*np.searchsorted(y, (py - reach_y, py + reach_y)))
        dx, dy = x[columns] - px, (y[rows] - py)[:, None]
        weight = np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
        seen.append(np.tensordot(planes[:, rows, columns], weight, 2) / weight.sum())
    return np.array(seen)


def stacked(rows):
    """Rows of Dr.Jit as one array, shape (points, rows)."""
    return np.stack([np.array(r) for r in rows], axis=1)


def matrices(a, b, c):
    """Covariances of the factors ``[[a, b], [0, c]]``, shape (N, 2, 2)."""
    factor = np.zeros((len(a), 2, 2))
    factor[:, 0, 0], factor[:, 0, 1], factor[:, 1, 1] = a, b, c
    return np.linalg.inv(np.swapaxes(factor, 1, 2) @ factor)

"""Sums seen through a footprint, by brute force."""

import numpy as np

from _helpers.sets import SIZE
from eigengs_dr.raster.reference import render_exact

CUTOFF = 5.0
FINE = 4
"""Samples a pixel of the pictures that brute force sums, along each axis."""


def some_points(count=60, size=SIZE, seed=3):
    """Random points in an image, rounded to float32, shape (count, 2)."""
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


def stacked(rows):
    """Rows of Dr.Jit as one array, shape (points, rows)."""
    return np.stack([np.array(r) for r in rows], axis=1)


def matrices(a, b, c):
    """Covariances of the factors ``[[a, b], [0, c]]``, shape (N, 2, 2)."""
    factor = np.zeros((len(a), 2, 2))
    factor[:, 0, 0], factor[:, 0, 1], factor[:, 1, 1] = a, b, c
    return np.linalg.inv(np.swapaxes(factor, 1, 2) @ factor)

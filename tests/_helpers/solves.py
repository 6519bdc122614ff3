"""Problems for solvers of colours, and what a solution leaves."""

import math

import numpy as np

from _helpers.sets import SIZE, Scene
from eigengs_dr.gaussian.file import CUTOFF

ROOMY = 12
"""Splats that overlap little: few steps converge."""


def roomy(count=ROOMY, channels=3):
    """Splats on a lattice, 5 pixels apart, with standard deviations around 2."""
    rng = np.random.default_rng(count)
    place = np.stack([np.arange(count) % 4, np.arange(count) // 4], axis=1)
    mean = place * 5.0 + 3 + rng.uniform(-0.5, 0.5, (count, 2))
    factor = np.array([0.5, 0, 0.5]) + rng.uniform(-0.1, 0.1, (count, 3))
    color = rng.uniform(-1, 1, (count, channels))
    arrays = mean, factor, color, np.linspace(0.1, 0.3, channels)
    return Scene(*(a.astype(np.float32).astype(float) for a in arrays))


def matrix(scene, cutoff=CUTOFF):
    """Columns: every splat at all pixels, and ones."""
    unit = scene._replace(color=np.eye(len(scene.mean)), background=np.zeros(len(scene.mean)))
    pixels = scene.size[0] * scene.size[1]
    return np.concatenate([unit.exact(cutoff).reshape(pixels, -1), np.ones((pixels, 1))], axis=1)


def best_colors(scene, image, cutoff=CUTOFF):
    """The colours and the background that fit an image best, in float64, and their error."""
    a, pixels = matrix(scene, cutoff), image.reshape(-1, image.shape[2]).astype(float)
    found = np.linalg.lstsq(a, pixels, rcond=None)[0]
    return found[:-1], found[-1], rms(a @ found - pixels)


def noise(channels=3, size=SIZE, seed=0):
    image = np.random.default_rng(seed).uniform(0, 1, (size[1], size[0], channels))
    return image.astype(np.float32)


def rms(values):
    return math.sqrt(np.mean(np.square(values, dtype=np.float64)))


def true_residual(solution, image, cutoff=CUTOFF):
    """What is left of the image, by the reference renderer on the solution's numbers."""
    found = solution.gaussians
    size = found.width, found.height
    scene = Scene(**{k: v.astype(float) for k, v in found.to_arrays().items()}, size=size)
    return rms(scene.exact(cutoff) - image)

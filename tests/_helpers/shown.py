"""Sets to show on a page, and how far their pictures are apart."""

import numpy as np

import eigengs_dr as eg
from _helpers.sets import random_scene

SIZE = (120, 90)

COUNT = 300


def make_set(space="rgb", channels=3, cutoff=3.0, count=COUNT):
    arrays = random_scene(1, count, SIZE, channels)
    color = arrays.color * 0.4
    background = np.full(channels, 0.4)
    return eg.Gaussians.from_arrays(
        arrays.mean, arrays.factor, color, background, size=SIZE, space=space, cutoff=cutoff
    )


def codes(gaussians, **size):
    """The renderer's picture in 8 bits, RGB."""
    picture = eg.picture_of(gaussians, **size)
    return np.broadcast_to(np.rint(255 * np.clip(picture, 0, 1)), (*picture.shape[:2], 3))


def differ(a, b):
    """Mean difference in steps of 8 bits."""
    assert a.shape == b.shape
    return np.abs(a - b).mean()

"""Random placement, and factors of covariances."""

import numpy as np

from _helpers.placements import covariances_of, generator
from eigengs_dr.fitting.start import place_random


def test_seeds_differ():
    image = np.zeros((20, 30, 3), np.float32)
    first, second = (place_random(image, 50, generator(seed))[0] for seed in (1, 2))
    assert not np.array_equal(first, second)


def test_random_is_uniform():
    """Means over the image; Cholesky factors over [0.5, 1.5], [0, 1], [0.5, 1.5]."""
    count = 20_000
    mean, factor = place_random(np.zeros((50, 200, 3)), count, generator())
    cholesky = np.linalg.cholesky(covariances_of(factor))
    drawn = [mean[:, 0] / 200, mean[:, 1] / 50]
    drawn += [cholesky[:, 0, 0] - 0.5, cholesky[:, 1, 0], cholesky[:, 1, 1] - 0.5]
    for values in drawn:
        quantiles = np.quantile(values, [0, 0.25, 0.5, 0.75, 1])
        np.testing.assert_allclose(quantiles, [0, 0.25, 0.5, 0.75, 1], atol=0.02)

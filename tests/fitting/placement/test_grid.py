"""Placement on a hexagonal grid."""

import numpy as np
import pytest

from _helpers.placements import generator
from eigengs_dr.fitting.start import DEVIATION, place_grid


@pytest.mark.parametrize(("width", "height", "count"), [(40, 40, 100), (64, 16, 64), (30, 50, 97)])
def test_grid(width, height, count):
    """Rows that differ by one splat at most and are shifted by half a distance; one size."""
    mean, factor = place_grid(np.zeros((height, width, 3)), count, generator())
    spacing = np.sqrt(width * height / count)
    heights = np.unique(mean[:, 1])
    numbers = [int((mean[:, 1] == y).sum()) for y in heights]
    assert max(numbers) - min(numbers) <= 1
    np.testing.assert_allclose(heights, (np.arange(len(heights)) + 0.5) * height / len(heights))
    for k, (y, number) in enumerate(zip(heights, numbers, strict=True)):
        x = mean[mean[:, 1] == y, 0]
        np.testing.assert_allclose(x / width * number, np.arange(number) + 0.25 + 0.5 * (k % 2))
    sharpness = 1 / (DEVIATION * spacing)
    np.testing.assert_allclose(factor, np.tile([sharpness, 0, sharpness], (count, 1)))


def test_grid_is_hexagonal():
    """Six nearest neighbours at one distance, where rows have one length."""
    mean, _ = place_grid(np.zeros((300, 300, 3)), 32 * 28, generator())
    middle = np.argmin(np.abs(mean - 150).sum(axis=1))
    distances = np.sort(np.linalg.norm(mean - mean[middle], axis=1))[1:8]
    assert distances[5] < 1.1 * distances[0] < 1.5 * distances[0] < distances[6]

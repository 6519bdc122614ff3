"""Every placement, on any image; on a hexagonal grid; at random."""

import numpy as np
import pytest
from hypothesis import given

from _helpers.placements import check_placement, covariances_of, generator, images_and_counts
from _helpers.sets import few
from eigengs_dr.fitting.placement.adaptive import place_adaptive
from eigengs_dr.fitting.start import DEVIATION, place_grid, place_random


def adaptive(image, count, generator):
    """Means and factors of the adaptive placement."""
    arrays = place_adaptive(image, count, "data", "llvm").to_arrays()
    return arrays["mean"], arrays["factor"]


INITS = [place_random, place_grid, adaptive]


@pytest.mark.parametrize("place", INITS)
@few
@given(drawn=images_and_counts())
def test_any_image_and_any_count(place, drawn):
    image, count = drawn
    mean, factor = place(image, count, generator())
    check_placement(mean, factor, count, image.shape[1::-1])


@pytest.mark.parametrize("place", INITS)
@pytest.mark.parametrize("shape", [(1, 1), (1, 17), (17, 1), (2, 2), (64, 3), (1, 512)])
@pytest.mark.parametrize("part", [0, 0.5, 1])
def test_narrow_images(place, shape, part):
    image = generator().uniform(0, 1, (*shape, 3)).astype(np.float32)
    count = max(1, round(part * shape[0] * shape[1]))
    mean, factor = place(image, count, generator())
    check_placement(mean, factor, count, shape[::-1])


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

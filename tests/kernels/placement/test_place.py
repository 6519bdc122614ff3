"""Every placement, on any image; on a hexagonal grid; at random."""

import numpy as np
import pytest
from hypothesis import given

from _helpers.halves import objective_of
from _helpers.placements import check_placement, covariances_of, generator, images_and_counts
from _helpers.sets import few
from eigengs_dr.fitting.place import (
    DEVIATION,
    Adaptive,
    Grid,
    Random,
    grid_of,
    random_shapes,
)
from eigengs_dr.paper.gaussianimage import RandomColors

places = pytest.mark.parametrize("place", [Adaptive(), Grid(), Random(), RandomColors()], ids=repr)


def check(place, image, count):
    """Check a set of a placement, its cutoff, and whether it has colours."""
    found = place(objective_of(image, "llvm", "data"), count, 4.0, 1)
    arrays = found.to_arrays()
    check_placement(arrays["mean"], arrays["factor"], count, image.shape[1::-1])
    assert (found.cutoff, found.space, found.channels) == (4, "data", image.shape[2])
    assert arrays["color"].any() == place.has_colors


@places
@few
@given(drawn=images_and_counts())
def test_any_image_and_any_count(place, drawn):
    check(place, *drawn)


@places
@pytest.mark.parametrize("shape", [(1, 1), (1, 17), (17, 1), (2, 2), (64, 3), (1, 512)])
@pytest.mark.parametrize("part", [0, 0.5, 1])
def test_narrow_images(place, shape, part):
    image = generator().uniform(0, 1, (*shape, 3)).astype(np.float32)
    count = max(1, round(part * shape[0] * shape[1]))
    check(place, image, count)


def test_chance_follows_the_seed_alone():
    """Every image of a batch gets the same places."""
    objective = objective_of(np.zeros((8, 9, 3), np.float32), "llvm")
    one, same, other = (Random()(objective, 20, 3.0, seed).mean.numpy() for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)


@pytest.mark.parametrize(("width", "height", "count"), [(40, 40, 100), (64, 16, 64), (30, 50, 97)])
def test_grid(width, height, count):
    """Rows that differ by one splat at most and are shifted by half a distance; one size."""
    mean, factor = grid_of((width, height), count)
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
    mean, _ = grid_of((300, 300), 32 * 28)
    middle = np.argmin(np.abs(mean - 150).sum(axis=1))
    distances = np.sort(np.linalg.norm(mean - mean[middle], axis=1))[1:8]
    assert distances[5] < 1.1 * distances[0] < 1.5 * distances[0] < distances[6]


def test_random_is_uniform():
    """Means over the image; Cholesky factors over [0.5, 1.5], [0, 1], [0.5, 1.5]."""
    count = 20_000
    mean, factor = random_shapes((200, 50), count, generator())
    cholesky = np.linalg.cholesky(covariances_of(factor))
    drawn = [mean[:, 0] / 200, mean[:, 1] / 50]
    drawn += [cholesky[:, 0, 0] - 0.5, cholesky[:, 1, 0], cholesky[:, 1, 1] - 0.5]
    for values in drawn:
        quantiles = np.quantile(values, [0, 0.25, 0.5, 0.75, 1])
        np.testing.assert_allclose(quantiles, [0, 0.25, 0.5, 0.75, 1], atol=0.02)

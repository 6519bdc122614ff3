"""Every placement, on any image."""

import numpy as np
import pytest
from hypothesis import given

from _helpers.placements import check_placement, generator, images_and_counts
from _helpers.sets import few
from eigengs_dr.fitting.placement.adaptive import place_adaptive
from eigengs_dr.fitting.start import place_grid, place_random


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


@pytest.mark.parametrize("place", INITS)
def test_one_seed_gives_one_placement(place):
    image = generator(1).uniform(0, 1, (20, 30, 3)).astype(np.float32)
    first, second = place(image, 50, generator(7)), place(image, 50, generator(7))
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])

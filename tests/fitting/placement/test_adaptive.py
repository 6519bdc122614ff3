"""Adaptive placement: its density, its pieces, its shapes."""

import numpy as np
import pytest
from hypothesis import given

from _helpers.placements import check_placement, covariances_of, generator, images_and_counts
from _helpers.sets import few
from eigengs_dr.fitting.placement.adaptive import (
    density_from_hessian,
    hessian_energy,
    lloyd_step,
    normalize_density,
    place_adaptive,
    stratify_along_hilbert,
)
from eigengs_dr.image.resize import resample


def test_adaptive_does_not_use_the_generator():
    image = generator(1).uniform(0, 1, (20, 30, 3)).astype(np.float32)
    first, second = place_adaptive(image, 50, generator(1)), place_adaptive(image, 50, generator(2))
    np.testing.assert_array_equal(first[0], second[0])


@few
@given(drawn=images_and_counts())
def test_density_of_any_image(drawn):
    """No pixel has more than one splat, none has nothing."""
    image, count = drawn
    pixels = image.shape[0] * image.shape[1]
    spacing = float(np.sqrt(pixels / count))
    density = normalize_density(density_from_hessian(image, spacing), count)
    assert density.shape == image.shape[:2]
    assert (density > 0).all()
    assert density.max() <= 1
    assert density.sum(dtype=float) <= count * (1 + 1e-5)


@pytest.mark.parametrize("count", [1, 10, 100, 400])
def test_density_sums_to_the_count(count):
    y, x = np.indices((40, 40)) / 40
    image = np.stack([np.sin(7 * x * x + y), np.cos(9 * y), x * y], axis=-1).astype(np.float32)
    spacing = float(np.sqrt(1600 / count))
    density = normalize_density(density_from_hessian(image, spacing), count)
    assert density.sum(dtype=float) == pytest.approx(count, rel=1e-5)


def test_bending_of_a_parabola():
    """Second derivatives 2 and 6 along the axes, 1 across: H H, whatever the blur."""
    y, x = np.indices((30, 40)).astype(np.float32)
    image = (x * x + 3 * y * y + x * y)[..., None]
    found = hessian_energy(image, 4.0)[:, 10:20, 10:30]
    hessian = np.array([[2.0, 1], [1, 6]])
    squared = hessian @ hessian
    expected = np.array([squared[0, 0], squared[1, 1], squared[0, 1]])[:, None, None]
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=2e-2)


def test_straight_ramps_do_not_bend():
    y, x = np.indices((30, 40)).astype(np.float32)
    image = np.stack([0.01 * x, 0.02 * y, 0.01 * (x + y)], axis=-1)
    flat = hessian_energy(np.zeros_like(image), 4.0)
    np.testing.assert_allclose(
        hessian_energy(image, 4.0)[:, 5:-5, 5:-5], flat[:, 5:-5, 5:-5], atol=1e-9
    )


def test_constant_image_is_covered_evenly():
    mean, factor = place_adaptive(np.full((64, 64, 3), 0.5, np.float32), 256, generator())
    quarter = (mean // 32).astype(int)
    numbers = np.bincount(quarter[:, 0] + 2 * quarter[:, 1], minlength=4)
    assert np.abs(numbers - 64).max() <= 3
    sigma = covariances_of(factor)
    np.testing.assert_allclose(
        sigma, np.tile(sigma[0, 0, 0] * np.eye(2), (256, 1, 1)), rtol=0.1, atol=0.5
    )


@pytest.mark.parametrize("upright", [True, False])
def test_splats_gather_at_an_edge_and_lie_along_it(upright):
    image = np.zeros((64, 64, 3), np.float32)
    image[:, 32:] = 1
    mean, factor = place_adaptive(image if upright else image.transpose(1, 0, 2), 200, generator())
    near = np.abs(mean[:, 0 if upright else 1] - 32) < 6
    assert near.mean() > 2 * 12 / 64
    sigma = covariances_of(factor[near])
    across, along = (0, 1) if upright else (1, 0)
    assert (sigma[:, along, along] > 2 * sigma[:, across, across]).mean() > 0.9


def test_splats_lie_along_a_slanted_edge():
    """At 45 degrees, falling to the right: the covariance of x and y is positive along it."""
    y, x = np.indices((64, 64))
    image = np.repeat((x > y)[..., None], 3, axis=2).astype(np.float32)
    mean, factor = place_adaptive(image, 200, generator())
    near = np.abs(mean[:, 0] - mean[:, 1]) < 6
    sigma = covariances_of(factor[near])
    along = sigma.sum(axis=(1, 2)) / 2  # variance along (1, 1) / sqrt 2
    across = along - 2 * sigma[:, 0, 1]
    assert (along > 2 * across).mean() > 0.9


def test_brightness_does_not_move_splats():
    image = generator(2).uniform(0, 0.5, (32, 32, 3)).astype(np.float32)
    first, second = (place_adaptive(image + shift, 80, generator())[0] for shift in (0, 0.25))
    np.testing.assert_allclose(first, second, atol=0.5)


def test_pieces_of_an_even_density_are_squares():
    """64 splats on 32 x 32 pixels: pieces of the curve are blocks of 4 x 4."""
    mean = stratify_along_hilbert(np.full((32, 32), 64 / 1024), 64)
    expected = {(4 * i + 2.0, 4 * j + 2.0) for i in range(8) for j in range(8)}
    assert {tuple(np.round(m, 6)) for m in mean} == expected


def test_one_piece_is_the_centroid():
    density = generator(3).uniform(0.1, 1, (9, 14))
    y, x = np.indices(density.shape) + 0.5
    expected = [(density * v).sum() / density.sum() for v in (x, y)]
    np.testing.assert_allclose(stratify_along_hilbert(density, 1)[0], expected)


def test_relaxation_moves_to_centroids():
    """Two centres share the pixels of an even strip: each moves to the middle of its half."""
    mean = lloyd_step(np.array([[1.2, 0.5], [8.9, 0.5]]), np.full((1, 10), 0.2))
    np.testing.assert_allclose(mean, [[2.5, 0.5], [7.5, 0.5]])


def test_relaxation_of_centres_in_one_pixel():
    """The last of them moves, the others stay: none is lost and none is NaN."""
    start = np.array([[2.5, 0.5], [2.6, 0.5], [2.7, 0.5]])
    mean = lloyd_step(start, np.full((1, 10), 0.3))
    np.testing.assert_allclose(mean, [[2.5, 0.5], [2.6, 0.5], [5, 0.5]])


def test_splats_far_apart_are_placed_on_a_smaller_image():
    """Their means and covariances are those of the small one, stretched along both axes."""
    image = np.random.default_rng(0).uniform(0, 1, (97, 160, 3)).astype(np.float32)
    small = resample(image, 54, 33)  # splats lie 27 pixels apart: a third
    mean, factor = place_adaptive(image, 21, generator())
    expected_mean, expected_factor = place_adaptive(small, 21, generator())
    stretch = np.array([160 / 54, 97 / 33])
    np.testing.assert_allclose(mean, expected_mean * stretch)
    covariance = covariances_of(expected_factor) * stretch * stretch[:, None]
    np.testing.assert_allclose(covariances_of(factor), covariance)
    check_placement(mean, factor, 21, (160, 97))


def test_density_given_to_adaptive_is_followed():
    image = np.zeros((40, 40, 3), np.float32)

    def left(default):
        density = np.full(default.shape, 1e-6)
        density[:, : default.shape[1] // 2] = 1
        return density

    mean, _ = place_adaptive(image, 100, density=left)
    assert (mean[:, 0] < 20.5).mean() > 0.95

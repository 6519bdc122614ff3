"""Adaptive placement: its density, its pieces, its shapes; and placement by the error."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

import eigengs_dr as eg
from _helpers.halves import SIDE, fitted, objective_for, objective_of, picture
from _helpers.placements import check_placement, covariances_of, generator, images_and_counts
from _helpers.plain_placement import (
    plain_blur,
    plain_shapes,
    plain_squared_hessian,
    to_canvas,
    to_pixels,
)
from _helpers.sets import few
from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.objective import Pixels
from eigengs_dr.fitting.place import Grid
from eigengs_dr.fitting.placement.adaptive import (
    DENSITY_BLUR,
    DENSITY_EXPONENT,
    DIRECTION_BLUR,
    IMAGE_BLUR,
    NOISE_SLOPE,
    density_from_hessian,
    normalize_density,
    place_adaptive,
    redistribute,
    shapes_from_hessian,
)
from eigengs_dr.image.color import rgb_to_ycbcr
from eigengs_dr.image.space import DATA
from eigengs_dr.raster.render import render


def placed(image, count, backend="llvm", density=None):
    """Means (N, 2) and factors (N, 3)."""
    objective = objective_of(image, backend, "data")
    arrays = place_adaptive(objective, count, density=density).to_arrays()
    return arrays["mean"], arrays["factor"]


def density_of(image, count, backend="llvm"):
    """Gaussians per pixel (H, W)."""
    canvas, values = to_canvas(image, backend)
    spacing = float(np.sqrt(image.shape[0] * image.shape[1] / count))
    _, density = density_from_hessian(canvas, values, spacing)
    return to_pixels(canvas, normalize_density(canvas, density, count))


@few
@given(drawn=images_and_counts())
def test_density_of_any_image(backend, drawn):
    """No pixel has more than one Gaussian, none has nothing."""
    image, count = drawn
    density = density_of(image, count, backend)
    assert (density > 0).all()
    assert density.max() <= 1
    assert density.sum(dtype=float) <= count * (1 + 1e-5)


@pytest.mark.parametrize("count", [1, 10, 100, 400])
def test_density_sums_to_the_count(backend, count):
    y, x = np.indices((40, 40)) / 40
    image = np.stack([np.sin(7 * x * x + y), np.cos(9 * y), x * y], axis=-1).astype(np.float32)
    assert density_of(image, count, backend).sum(dtype=float) == pytest.approx(count, rel=1e-5)


@pytest.mark.parametrize("shape", [(40, 52), (37, 61)])
def test_density_and_shapes_are_those_of_numpy(backend, shape):
    image = generator(4).uniform(0, 1, (*shape, 3)).astype(np.float32)
    image = plain_blur(image, 1.5).astype(np.float32)
    count = shape[0] * shape[1] // 12
    spacing = float(np.sqrt(shape[0] * shape[1] / count))
    energy = plain_squared_hessian(
        plain_blur(image, IMAGE_BLUR * spacing), (NOISE_SLOPE / spacing**2) ** 2 / 2
    )
    trace = plain_blur(energy[..., :2].sum(axis=2), DENSITY_BLUR * spacing)
    expected = trace**DENSITY_EXPONENT
    canvas, values = to_canvas(image, backend)
    found_energy, found = density_from_hessian(canvas, values, spacing)
    np.testing.assert_allclose(to_pixels(canvas, found), expected, rtol=1e-3)
    column, row = (generator(5).integers(0, side, 30) for side in shape[::-1])
    mean = [canvas.types.Float((v + 0.5).astype(np.float32)) for v in (column, row)]
    factor = shapes_from_hessian(canvas, tuple(mean), found, found_energy, spacing)
    energy = plain_blur(energy, DIRECTION_BLUR * spacing)[row, column]
    sigma = covariances_of(plain_shapes(energy, expected[row, column]))
    np.testing.assert_allclose(
        covariances_of(factor.numpy().T), sigma, rtol=5e-3, atol=1e-3 * sigma.max()
    )


def test_constant_image_is_covered_evenly(backend):
    mean, factor = placed(np.full((64, 64, 3), 0.5, np.float32), 256, backend)
    quarter = (mean // 32).astype(int)
    numbers = np.bincount(quarter[:, 0] + 2 * quarter[:, 1], minlength=4)
    assert np.abs(numbers - 64).max() <= 3
    sigma = covariances_of(factor)
    np.testing.assert_allclose(
        sigma, np.tile(sigma[0, 0, 0] * np.eye(2), (256, 1, 1)), rtol=0.1, atol=0.5
    )


def test_splats_lie_along_a_slanted_edge(backend):
    """At 45 degrees, falling to the right: the covariance of x and y is positive along it."""
    y, x = np.indices((64, 64))
    image = np.repeat((x > y)[..., None], 3, axis=2).astype(np.float32)
    mean, factor = placed(image, 200, backend)
    near = np.abs(mean[:, 0] - mean[:, 1]) < 6
    sigma = covariances_of(factor[near])
    along = sigma.sum(axis=(1, 2)) / 2  # variance along (1, 1) / sqrt 2
    across = along - 2 * sigma[:, 0, 1]
    assert (along > 2 * across).mean() > 0.9


def test_splats_far_apart_are_placed_on_a_smaller_image(backend):
    """Their means and covariances are those of the small one, enlarged."""
    small = generator().uniform(0, 1, (33, 53, 3)).astype(np.float32)
    image = np.kron(small, np.ones((3, 3, 1), np.float32))[:97, :158]  # splats lie 27 pixels apart
    mean, factor = placed(image, 21, backend)
    expected_mean, expected_factor = placed(small, 21, backend)
    np.testing.assert_allclose(mean, 3 * expected_mean, rtol=1e-4)
    np.testing.assert_allclose(factor, expected_factor / 3, rtol=1e-3, atol=1e-5)
    check_placement(mean, factor, 21, (158, 97))


def test_density_given_to_adaptive_is_followed(backend):
    def left(canvas, default, times):
        column, _, _, _ = canvas.pixels()
        return canvas.types.Float(column) * -0.99999 / 39 + 1

    mean, _ = placed(np.zeros((40, 40, 3), np.float32), 100, backend, left)
    assert (mean[:, 0] < 20).mean() > 0.7


def test_sets_of_a_batch_are_those_of_its_images(backend):
    batch = generator(7).uniform(0, 1, (3, 30, 33, 3)).astype(np.float32)

    def placed_for(*images):
        objective = Pixels.of(np.stack(images), DATA, types_in(select(backend)))
        return place_adaptive(objective, 60)

    found = placed_for(*batch)
    for name in ("mean", "factor"):
        rows = getattr(found, name).numpy().T
        for image, own in zip(batch, np.split(rows, 3), strict=True):
            np.testing.assert_array_equal(own, getattr(placed_for(image), name).numpy().T)


@pytest.mark.parametrize("side", [32, 150])
def test_rearranged_has_the_count_and_goes_where_the_error_is(side):
    """Also where splats are so far apart that they are placed on a smaller image."""
    image = np.kron(picture(), np.ones((-(-side // SIDE), -(-side // SIDE), 1)))[:side, :side]
    objective = objective_of(image.astype(np.float32))
    start = replace(eg.DEFAULT, place=Grid()).place_and_solve(objective, 64)
    result = redistribute(start, objective, 50)
    left = result.mean.numpy()[0] < side / 2
    assert len(result) == 50
    assert left.mean() > 0.6  # half of the area, most of the error
    assert np.isfinite(render(result).numpy()).all()


def test_weights_draw_splats():
    gaussians, _ = fitted()
    weight = np.ones((SIDE, SIDE), np.float32)
    weight[SIDE // 2 :] = 1e-6
    objective = objective_for(gaussians, rgb_to_ycbcr(picture()), weight)
    result = redistribute(gaussians, objective, 60)
    assert (result.mean.numpy()[1] < SIDE / 2).mean() > 0.7

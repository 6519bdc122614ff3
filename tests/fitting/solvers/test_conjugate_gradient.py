"""The best colours: against dense least squares, and what conjugate gradients promise."""

import drjit as dr
import numpy as np
import pytest
from drjit import JitFlag
from hypothesis import given

from _helpers.sets import SIZE, Scene, check_equal, few, random_scene, scenes
from _helpers.solves import best_colors, matrix, noise, rms, roomy, true_residual
from eigengs_dr.fitting.solvers.conjugate_gradient import solve
from eigengs_dr.raster.render import render


@pytest.mark.parametrize(("channels", "steps"), [(1, 40), (2, 40), (3, 40), (3, 200), (4, 40)])
def test_least_squares(backend, channels, steps):
    scene, image = roomy(channels=channels), noise(channels)
    solution = solve(scene.on(backend), image, steps)
    color, background, error = best_colors(scene, image)
    found = solution.gaussians.to_arrays()
    np.testing.assert_allclose(found["color"], color, atol=1e-4)
    np.testing.assert_allclose(found["background"], background, atol=1e-5)
    assert solution.residuals[-1] == pytest.approx(error, rel=1e-6)


def test_least_squares_in_double_precision(backend):
    scene, image = roomy(), noise()
    solution = solve(scene.on(backend, 64), image, steps=60)
    found = solution.gaussians.to_arrays()
    assert found["color"].dtype == np.float64
    np.testing.assert_allclose(found["color"], best_colors(scene, image)[0], atol=1e-9)


def test_what_zero_steps_give(backend):
    """No colours, over the mean of the image."""
    image = noise()
    solution = solve(random_scene().on(backend), image, steps=0)
    found = solution.gaussians.to_arrays()
    assert not found["color"].any()
    np.testing.assert_allclose(found["background"], image.mean(axis=(0, 1)), rtol=1e-6)
    assert solution.residuals == [pytest.approx(rms(image - image.mean(axis=(0, 1))), rel=1e-6)]


def test_background_of_a_large_image(backend):
    image = np.full((512, 512, 3), 0.3, np.float32)
    solution = solve(random_scene(size=(512, 512)).on(backend), image, steps=0)
    np.testing.assert_allclose(solution.gaussians.to_arrays()["background"], 0.3, rtol=1e-6)


def test_shapes_stay(backend):
    gaussians = random_scene().on(backend, space="rgb")
    before = gaussians.to_arrays()
    solved = solve(gaussians, noise(), steps=3).gaussians
    for name in ("mean", "factor"):
        np.testing.assert_array_equal(solved.to_arrays()[name], before[name])
    check_equal(gaussians, before)
    assert (solved.width, solved.height, solved.space) == (*SIZE, "rgb")


@pytest.mark.parametrize("steps", [1, 2, 5])
@pytest.mark.parametrize("warm_start", [False, True])
def test_reported_residual_is_the_true_one(backend, steps, warm_start):
    image = noise()
    solution = solve(random_scene().on(backend), image, steps, warm_start=warm_start)
    assert len(solution.residuals) == steps + 1
    assert solution.residuals[-1] == pytest.approx(true_residual(solution, image), rel=1e-5)


@few
@given(scene=scenes())
def test_residuals_never_grow(backend, scene):
    residuals = np.array(solve(scene.on(backend), noise(), steps=20).residuals)
    assert np.isfinite(residuals).all()
    assert (np.diff(residuals) <= 1e-6 * residuals[0]).all()


def test_preconditioner(backend):
    """Splats apart, scaled by the diagonal, leave 3 eigenvalues: only the background couples."""
    mean = np.array([[3.5, 3.5], [15.5, 4.5], [3.5, 12.5], [14.5, 13.5], [9.5, 8.5]])
    sharpness = np.array([2.0, 0.75, 1.5, 1.0, 3.0])
    factor = np.stack([sharpness, 0 * sharpness, sharpness], axis=1)
    color = np.random.default_rng(0).uniform(0.5, 1, (5, 3))
    scene = Scene(mean, factor, color, np.array([0.1, 0.2, 0.3]))
    gaussians = scene.on(backend)
    residuals = solve(gaussians, render(gaussians).numpy(), steps=3).residuals
    assert residuals[2] > 1e-3
    assert residuals[3] < 1e-5


def test_warm_start_continues(backend):
    image = noise()
    first = solve(random_scene().on(backend), image, steps=5)
    second = solve(first.gaussians, image, steps=5, warm_start=True)
    assert second.residuals[0] == pytest.approx(first.residuals[-1], rel=1e-5)
    assert second.residuals[-1] < first.residuals[-1]


def test_solutions_are_bit_equal(backend):
    """Also without the recording of a step."""
    gaussians, found = random_scene().on(backend), []
    for recorded in (True, True, False):
        with dr.scoped_set_flag(JitFlag.KernelFreezing, recorded):
            found.append(solve(gaussians, noise(), steps=4))
    for other in found[1:]:
        assert other.residuals == found[0].residuals
        check_equal(other.gaussians, found[0].gaussians.to_arrays())


@pytest.mark.parametrize("warm_start", [False, True])
def test_a_background_that_is_given_stays(backend, warm_start):
    scene, image, given = roomy(), noise(), np.array([0.2, 0.5, 0.6], np.float32)
    found = solve(scene.on(backend), image, 40, background=given, warm_start=warm_start)
    left = image.reshape(-1, 3) - given.astype(float)
    best = np.linalg.lstsq(matrix(scene)[:, :-1], left, rcond=None)[0]
    arrays = found.gaussians.to_arrays()
    np.testing.assert_array_equal(arrays["background"], given)
    np.testing.assert_allclose(arrays["color"], best, atol=1e-4)


@pytest.mark.parametrize("steps", [1, 4])
def test_sets_and_images_of_several_sizes_one_after_the_other(backend, steps):
    """The program of a step is frozen: it must not be replayed for another size."""
    for count, size in ((12, SIZE), (48, SIZE), (7, SIZE), (24, (16, 16)), (24, (5, 9))):
        image = noise(size=size)
        solution = solve(random_scene(count, count, size).on(backend), image, steps)
        assert solution.residuals[-1] == pytest.approx(true_residual(solution, image), rel=1e-5)

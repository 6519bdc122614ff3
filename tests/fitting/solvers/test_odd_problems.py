"""The best colours for odd sets and images, and what is refused."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from _helpers.sets import COUNT, SIZE, random_scene, scene_of
from _helpers.solves import best_colors, noise, rms, roomy
from eigengs_dr.fitting.solvers.conjugate_gradient import solve
from eigengs_dr.raster.render import render


@pytest.mark.parametrize("cutoff", [2.0, 5.0, 9.0, 10.0, 12.0])
def test_cutoffs(backend, cutoff):
    scene, image = roomy(), noise()
    solution = solve(replace(scene.on(backend), cutoff=cutoff), image, steps=40)
    best, *_ = best_colors(scene, image, cutoff)
    np.testing.assert_allclose(solution.gaussians.to_arrays()["color"], best, atol=1e-4)


@pytest.mark.parametrize("size", [(1, 1), (9, 1), (5, 4), (5, 13)])
def test_sizes(backend, size):
    """Also of fewer pixels than splats."""
    scene, image = random_scene(size=size), noise(size=size)
    solution = solve(scene.on(backend), image, steps=10)
    assert all(np.isfinite(v).all() for v in solution.gaussians.to_arrays().values())
    assert solution.residuals[-1] <= solution.residuals[0] + 1e-7


def test_splats_outside_the_image(backend):
    """Nothing is known of their colours: they stay as they were."""
    scene = random_scene()
    mean = scene.mean.copy()
    mean[::2] += 500
    gaussians = scene._replace(mean=mean).on(backend)
    cold = solve(gaussians, noise(), steps=10)
    inside = solve(scene.permuted(slice(1, None, 2)).on(backend), noise(), steps=10)
    assert not cold.gaussians.to_arrays()["color"][::2].any()
    np.testing.assert_allclose(cold.residuals, inside.residuals, rtol=1e-5)
    warm = solve(gaussians, noise(), steps=10, warm_start=True).gaussians.to_arrays()["color"]
    np.testing.assert_array_equal(warm[::2], np.float32(scene.color[::2]))


def test_all_splats_outside(backend):
    scene = random_scene()
    image = noise()
    solution = solve(scene._replace(mean=scene.mean - 500).on(backend), image, steps=3)
    assert solution.residuals == pytest.approx([rms(image - image.mean(axis=(0, 1)))] * 4)


def test_splats_all_the_same(backend):
    """As good as one of them, after any number of steps."""
    found = [scene_of(np.full((COUNT, 8), value)) for value in np.linspace(0.3, 0.7, 21)]
    for scene in (scene_of(np.full((COUNT, 8), 0.52654237)), *found):
        *_, best = best_colors(scene.permuted([0]), noise())
        residuals = solve(scene.on(backend), noise(), steps=40).residuals
        assert residuals[-1] == pytest.approx(best, rel=1e-4)
        assert (np.diff(residuals) <= 1e-6).all()


@pytest.mark.parametrize("value", [0.0, 0.3, 1.0])
def test_constant_images(backend, value):
    image = np.full((SIZE[1], SIZE[0], 3), value, np.float32)
    solution = solve(random_scene().on(backend), image, steps=10)
    assert max(solution.residuals) < 2e-6
    np.testing.assert_allclose(render(solution.gaussians), image, atol=1e-6)


@pytest.mark.parametrize("dtype", [np.float64, np.int64, np.uint8])
def test_types_of_images(backend, dtype):
    image = (noise() * 4).astype(dtype)
    expected = solve(random_scene().on(backend), image.astype(np.float32), steps=3)
    found = solve(random_scene().on(backend), image, steps=3)
    assert found.residuals == pytest.approx(expected.residuals, rel=1e-6)


def test_a_set_with_derivatives(backend):
    gaussians = random_scene().on(backend)
    dr.enable_grad(gaussians.mean, gaussians.color)
    solution = solve(gaussians, noise(), steps=2)
    assert not dr.grad_enabled(solution.gaussians.color)
    assert dr.grad_enabled(gaussians.mean)


def test_values_that_all_splats_share(backend):
    scene = random_scene()._replace(factor=np.tile([0.5, 0.25, 0.75], (COUNT, 1)))
    gaussians = scene.on(backend)
    shared = replace(gaussians, factor=type(gaussians.factor)(0.5, 0.25, 0.75))
    assert solve(shared, noise(), 3).residuals == solve(gaussians, noise(), 3).residuals


@pytest.mark.parametrize("shape", [(17, 22, 1), (22, 17, 3), (17, 22), (16, 22, 3), (17, 22, 4)])
def test_wrong_shape(backend, shape):
    with pytest.raises(
        ValueError, match=r"image has shape .*, the set needs \(17, 22, 3\)"
    ) as error:
        solve(random_scene().on(backend), np.zeros(shape))
    assert "\n" not in str(error.value)


def test_negative_steps_are_refused(backend):
    with pytest.raises(ValueError, match="steps"):
        solve(random_scene().on(backend), noise(), steps=-1)


@pytest.mark.parametrize("cutoff", [0.0, 13.0])
def test_cutoffs_out_of_range_are_refused(backend, cutoff):
    with pytest.raises(ValueError, match="cutoff"):
        solve(replace(random_scene().on(backend), cutoff=cutoff), noise())

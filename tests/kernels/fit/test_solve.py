"""The best colours: against dense least squares, what conjugate gradients promise, odd sets."""

import math
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from hypothesis import given

import eigengs_dr as eg
from _helpers.sets import COUNT, SIZE, Scene, check_equal, few, random_scene, scenes
from eigengs_dr.fitting.objective import Pixels
from eigengs_dr.fitting.solve import solve as solve_objective


def roomy(count=COUNT // 2, channels=3):
    """Splats on a lattice, 5 pixels apart, with deviations around 2: few steps converge."""
    rng = np.random.default_rng(count)
    place = np.stack([np.arange(count) % 4, np.arange(count) // 4], axis=1)
    mean = place * 5.0 + 3 + rng.uniform(-0.5, 0.5, (count, 2))
    factor = np.array([0.5, 0, 0.5]) + rng.uniform(-0.1, 0.1, (count, 3))
    color = rng.uniform(-1, 1, (count, channels))
    arrays = mean, factor, color, np.linspace(0.1, 0.3, channels)
    return Scene(*(a.astype(np.float32).astype(float) for a in arrays))


def solve(gaussians, image, steps=10, warm_start=False, weight=None):
    """The solve for an image (H, W, C) in the space of the set, with weights."""
    return solve_objective(gaussians, Pixels.plain(image, gaussians, weight), steps, warm_start)


def best_colors(scene, image, weight=None, cutoff=3.0):
    """The best colours and background of each channel for weights (H, W, C), in float64."""
    unit = scene._replace(color=np.eye(len(scene.mean)), background=np.zeros(len(scene.mean)))
    columns = unit.exact(cutoff).reshape(image.shape[0] * image.shape[1], -1)
    columns = np.column_stack([columns, np.ones(len(columns))])
    weight = np.ones_like(image) if weight is None else weight
    factors = np.sqrt(weight.astype(float)).reshape(-1, image.shape[2]).T
    pixels = image.reshape(-1, image.shape[2]).astype(float).T
    pairs = zip(factors, pixels, strict=True)
    found = [np.linalg.lstsq(f[:, None] * columns, f * p, rcond=None)[0] for f, p in pairs]
    return np.stack(found, axis=1)[:-1], np.stack(found, axis=1)[-1]


def noise(channels=3, size=SIZE):
    image = np.random.default_rng(0).uniform(0, 1, (size[1], size[0], channels))
    return image.astype(np.float32)


def rms(values):
    return math.sqrt(np.mean(np.square(values, dtype=np.float64)))


def true_error(found, image):
    """What a set leaves of an image, by the reference renderer on its numbers."""
    size = found.width, found.height
    scene = Scene(**{k: v.astype(float) for k, v in found.to_arrays().items()}, size=size)
    return rms(scene.exact(found.cutoff) - image)


@pytest.mark.parametrize(
    ("channels", "steps", "cutoff"), [(1, 40, 3.0), (3, 40, 3.0), (3, 40, 2.0), (3, 200, 3.0)]
)
def test_least_squares(backend, channels, steps, cutoff):
    """Shapes stay as they are, and so does the set that was given."""
    scene, image = roomy(channels=channels), noise(channels)
    gaussians = replace(scene.on(backend), cutoff=cutoff)
    solution = solve(gaussians, image, steps)
    color, background = best_colors(scene, image, cutoff=cutoff)
    found = solution.to_arrays()
    np.testing.assert_allclose(found["color"], color, atol=1e-4)
    np.testing.assert_allclose(found["background"], background, atol=1e-5)
    for name in ("mean", "factor"):
        np.testing.assert_array_equal(found[name], np.float32(getattr(scene, name)))
    check_equal(gaussians, scene._asdict())


@pytest.mark.parametrize("scale", [1, 1e-4, 1e4])
@pytest.mark.parametrize("layers", [0, 1, 3])
def test_weighted_least_squares(backend, layers, scale):
    """Of pixels, or of their channels; what has no weight may be anything finite."""
    scene, image, generator = roomy(), noise(), np.random.default_rng(5)
    shape = (*image.shape[:2], layers) if layers else image.shape[:2]
    weight = generator.uniform(0.2, 2, shape).astype(np.float32)
    weight[4:7, 3:9] = 0
    image[4:7, 3:9] = 50
    whole = np.broadcast_to(weight.reshape(*image.shape[:2], -1), image.shape)
    found = solve(scene.on(backend), image, 60, weight=np.float32(scale) * weight).to_arrays()
    color, background = best_colors(scene, image, whole)
    np.testing.assert_allclose(found["color"], color, atol=2e-3)
    np.testing.assert_allclose(found["background"], background, atol=2e-4)


def test_what_zero_steps_give(backend):
    """No colours over the mean of the image, of each channel; 0 for one without weight."""
    image, weight = noise(), np.random.default_rng(5).uniform(0, 1, noise().shape)
    found = solve(random_scene().on(backend), image, steps=0).to_arrays()
    assert not found["color"].any()
    np.testing.assert_allclose(found["background"], image.mean(axis=(0, 1)), rtol=1e-6)
    weight[..., 2] = 0
    found = solve(random_scene().on(backend), image, 0, weight=weight.astype(np.float32))
    expected = [np.average(image[..., c], weights=weight[..., c]) for c in range(2)]
    np.testing.assert_allclose(found.to_arrays()["background"], [*expected, 0], rtol=1e-5)


@few
@given(scene=scenes())
def test_errors_never_grow(backend, scene):
    image = noise()
    gaussians = scene.on(backend)
    errors = [true_error(solve(gaussians, image, steps), image) for steps in (0, 1, 2, 5, 20)]
    assert np.isfinite(errors).all()
    assert (np.diff(errors) <= 1e-6 * errors[0]).all()


def test_preconditioner(backend):
    """Splats apart, scaled by the diagonal, leave 3 eigenvalues: only the background couples."""
    mean = np.array([[3.5, 3.5], [15.5, 4.5], [3.5, 12.5], [14.5, 13.5], [9.5, 8.5]])
    sharpness = np.array([2.0, 0.75, 1.5, 1.0, 3.0])
    factor = np.stack([sharpness, 0 * sharpness, sharpness], axis=1)
    color = np.random.default_rng(0).uniform(0.5, 1, (5, 3))
    scene = Scene(mean, factor, color, np.array([0.1, 0.2, 0.3]))
    gaussians = scene.on(backend)
    image = eg.render(gaussians).numpy()
    two, three = (rms(eg.render(solve(gaussians, image, k)).numpy() - image) for k in (2, 3))
    assert two > 1e-3
    assert three < 1e-5


def test_warm_start_continues(backend):
    image = noise()
    first = solve(random_scene().on(backend), image, steps=5)
    check_equal(solve(first, image, steps=0, warm_start=True), first.to_arrays())
    second = solve(first, image, steps=5, warm_start=True)
    assert true_error(second, image) < true_error(first, image)


def test_sets_and_images_of_several_sizes_one_after_the_other(backend):
    """The program of a step is frozen: it must not be replayed for another size."""
    for count, size in (
        (12, SIZE),
        (48, SIZE),
        (7, SIZE),
        (24, (16, 16)),
        (24, (5, 9)),
        (24, (1, 1)),
    ):
        image = noise(size=size)
        gaussians = random_scene(count, count, size).on(backend)
        found = solve(gaussians, image, 4)
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
            check_equal(solve(gaussians, image, 4), found.to_arrays())
        assert true_error(found, image) <= true_error(solve(gaussians, image, 0), image) + 1e-6


def test_splats_outside_the_image(backend):
    """Nothing is known of their colours: they stay as they were."""
    scene = random_scene()
    mean = scene.mean.copy()
    mean[::2] += 500
    gaussians = scene._replace(mean=mean).on(backend)
    cold = solve(gaussians, noise(), steps=10)
    inside = solve(scene.permuted(slice(1, None, 2)).on(backend), noise(), steps=10)
    assert not cold.to_arrays()["color"][::2].any()
    color = inside.to_arrays()["color"]
    np.testing.assert_allclose(cold.to_arrays()["color"][1::2], color, atol=1e-5)
    warm = solve(gaussians, noise(), steps=10, warm_start=True).to_arrays()["color"]
    np.testing.assert_array_equal(warm[::2], np.float32(scene.color[::2]))

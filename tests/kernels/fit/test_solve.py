"""The best colours: against dense least squares, what conjugate gradients promise, odd sets."""

import math
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from drjit import JitFlag
from hypothesis import given

from _helpers.sets import COUNT, SIZE, Scene, check_equal, few, random_scene, scene_of, scenes
from eigengs_dr.fitting.objective import Pixels
from eigengs_dr.fitting.solve import solve as solve_objective
from eigengs_dr.gaussian.file import CUTOFF
from eigengs_dr.raster.render import render


def roomy(count=12, channels=3):
    """Splats on a lattice, 5 pixels apart, with deviations around 2: few steps converge."""
    rng = np.random.default_rng(count)
    place = np.stack([np.arange(count) % 4, np.arange(count) // 4], axis=1)
    mean = place * 5.0 + 3 + rng.uniform(-0.5, 0.5, (count, 2))
    factor = np.array([0.5, 0, 0.5]) + rng.uniform(-0.1, 0.1, (count, 3))
    color = rng.uniform(-1, 1, (count, channels))
    arrays = mean, factor, color, np.linspace(0.1, 0.3, channels)
    return Scene(*(a.astype(np.float32).astype(float) for a in arrays))


def solve(gaussians, image, steps=10, warm_start=False, background=None, weight=None):
    """The solve for an image (H, W, C) in the space of the set, with weights."""
    objective = Pixels.plain(image, gaussians, weight)
    return solve_objective(gaussians, objective, steps, warm_start, background)


def matrix(scene, cutoff=CUTOFF):
    """Columns: every splat at all pixels, and ones."""
    unit = scene._replace(color=np.eye(len(scene.mean)), background=np.zeros(len(scene.mean)))
    pixels = scene.size[0] * scene.size[1]
    return np.concatenate([unit.exact(cutoff).reshape(pixels, -1), np.ones((pixels, 1))], axis=1)


def best_colors(scene, image, cutoff=CUTOFF):
    """The colours and the background that fit an image best, in float64, and their error."""
    a, pixels = matrix(scene, cutoff), image.reshape(-1, image.shape[2]).astype(float)
    found = np.linalg.lstsq(a, pixels, rcond=None)[0]
    return found[:-1], found[-1], rms(a @ found - pixels)


def noise(channels=3, size=SIZE, seed=0):
    image = np.random.default_rng(seed).uniform(0, 1, (size[1], size[0], channels))
    return image.astype(np.float32)


def rms(values):
    return math.sqrt(np.mean(np.square(values, dtype=np.float64)))


def true_error(found, image, cutoff=CUTOFF):
    """What a set leaves of an image, by the reference renderer on its numbers."""
    size = found.width, found.height
    scene = Scene(**{k: v.astype(float) for k, v in found.to_arrays().items()}, size=size)
    return rms(scene.exact(cutoff) - image)


@pytest.mark.parametrize(("channels", "steps"), [(1, 40), (2, 40), (3, 40), (3, 200), (4, 40)])
def test_least_squares(backend, channels, steps):
    scene, image = roomy(channels=channels), noise(channels)
    solution = solve(scene.on(backend), image, steps)
    color, background, error = best_colors(scene, image)
    found = solution.to_arrays()
    np.testing.assert_allclose(found["color"], color, atol=1e-4)
    np.testing.assert_allclose(found["background"], background, atol=1e-5)
    assert true_error(solution, image) == pytest.approx(error, rel=1e-6)


def test_least_squares_in_double_precision(backend):
    scene, image = roomy(), noise()
    found = solve(scene.on(backend, 64), image, steps=60).to_arrays()
    assert found["color"].dtype == np.float64
    np.testing.assert_allclose(found["color"], best_colors(scene, image)[0], atol=1e-9)


def best_weighted(scene, image, weight):
    """The best colours and background of each channel for weights (H, W, C), in float64."""
    a, factors = matrix(scene), np.sqrt(weight.astype(float)).reshape(-1, image.shape[2])
    pixels = image.reshape(-1, image.shape[2]).astype(float)
    columns = [
        np.linalg.lstsq(f[:, None] * a, f * p, rcond=None)[0]
        for f, p in zip(factors.T, pixels.T, strict=True)
    ]
    found = np.stack(columns, axis=1)
    return found[:-1], found[-1]


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
    color, background = best_weighted(scene, image, whole)
    np.testing.assert_allclose(found["color"], color, atol=2e-3)
    np.testing.assert_allclose(found["background"], background, atol=2e-4)


def test_what_zero_steps_give_with_weights(backend):
    """The weighted mean of the image, for each channel; 0 for a channel without weight."""
    image, weight = noise(), np.random.default_rng(5).uniform(0, 1, noise().shape)
    weight[..., 2] = 0
    found = solve(random_scene().on(backend), image, 0, weight=weight.astype(np.float32))
    expected = [np.average(image[..., c], weights=weight[..., c]) for c in range(2)]
    np.testing.assert_allclose(found.to_arrays()["background"], [*expected, 0], rtol=1e-5)


def test_equal_weights_are_none(backend):
    """But for the rounding of the mean, with which a solve starts."""
    gaussians = random_scene().on(backend)
    plain = solve(gaussians, noise(), 4).to_arrays()
    found = solve(gaussians, noise(), 4, weight=np.ones(SIZE[::-1], np.float32)).to_arrays()
    for name in ("color", "background"):
        np.testing.assert_allclose(found[name], plain[name], atol=1e-5)


def test_what_zero_steps_give(backend):
    """No colours, over the mean of the image."""
    image = noise()
    found = solve(random_scene().on(backend), image, steps=0).to_arrays()
    assert not found["color"].any()
    np.testing.assert_allclose(found["background"], image.mean(axis=(0, 1)), rtol=1e-6)


def test_background_of_a_large_image(backend):
    image = np.full((512, 512, 3), 0.3, np.float32)
    solution = solve(random_scene(size=(512, 512)).on(backend), image, steps=0)
    np.testing.assert_allclose(solution.to_arrays()["background"], 0.3, rtol=1e-6)


def test_shapes_stay(backend):
    gaussians = random_scene().on(backend, space="rgb")
    before = gaussians.to_arrays()
    solved = solve(gaussians, noise(), steps=3)
    for name in ("mean", "factor"):
        np.testing.assert_array_equal(solved.to_arrays()[name], before[name])
    check_equal(gaussians, before)
    assert (solved.width, solved.height, solved.space) == (*SIZE, "rgb")


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
    image = render(gaussians).numpy()
    two, three = (rms(render(solve(gaussians, image, k)).numpy() - image) for k in (2, 3))
    assert two > 1e-3
    assert three < 1e-5


def test_warm_start_continues(backend):
    image = noise()
    first = solve(random_scene().on(backend), image, steps=5)
    check_equal(solve(first, image, steps=0, warm_start=True), first.to_arrays())
    second = solve(first, image, steps=5, warm_start=True)
    assert true_error(second, image) < true_error(first, image)


def test_solutions_are_bit_equal(backend):
    """Also without the recording of a step."""
    gaussians, found = random_scene().on(backend), []
    for recorded in (True, True, False):
        with dr.scoped_set_flag(JitFlag.KernelFreezing, recorded):
            found.append(solve(gaussians, noise(), steps=4))
    for other in found[1:]:
        check_equal(other, found[0].to_arrays())


@pytest.mark.parametrize("warm_start", [False, True])
def test_a_background_that_is_given_stays(backend, warm_start):
    scene, image, given = roomy(), noise(), np.array([0.2, 0.5, 0.6], np.float32)
    found = solve(scene.on(backend), image, 40, background=given, warm_start=warm_start)
    left = image.reshape(-1, 3) - given.astype(float)
    best = np.linalg.lstsq(matrix(scene)[:, :-1], left, rcond=None)[0]
    arrays = found.to_arrays()
    np.testing.assert_array_equal(arrays["background"], given)
    np.testing.assert_allclose(arrays["color"], best, atol=1e-4)


@pytest.mark.parametrize("steps", [1, 4])
def test_sets_and_images_of_several_sizes_one_after_the_other(backend, steps):
    """The program of a step is frozen: it must not be replayed for another size."""
    for count, size in ((12, SIZE), (48, SIZE), (7, SIZE), (24, (16, 16)), (24, (5, 9))):
        image = noise(size=size)
        gaussians = random_scene(count, count, size).on(backend)
        found = solve(gaussians, image, steps)
        with dr.scoped_set_flag(JitFlag.KernelFreezing, False):
            check_equal(solve(gaussians, image, steps), found.to_arrays())


@pytest.mark.parametrize("cutoff", [2.0, 5.0, 9.0, 10.0, 12.0])
def test_cutoffs(backend, cutoff):
    scene, image = roomy(), noise()
    solution = solve(replace(scene.on(backend), cutoff=cutoff), image, steps=40)
    best, *_ = best_colors(scene, image, cutoff)
    np.testing.assert_allclose(solution.to_arrays()["color"], best, atol=1e-4)


@pytest.mark.parametrize("size", [(1, 1), (9, 1), (5, 4), (5, 13)])
def test_sizes(backend, size):
    """Also of fewer pixels than splats."""
    scene, image = random_scene(size=size), noise(size=size)
    before, after = (solve(scene.on(backend), image, steps) for steps in (0, 10))
    assert all(np.isfinite(v).all() for v in after.to_arrays().values())
    assert true_error(after, image) <= true_error(before, image) + 1e-6


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


def test_all_splats_outside(backend):
    scene = random_scene()
    image = noise()
    solution = solve(scene._replace(mean=scene.mean - 500).on(backend), image, steps=3)
    found = solution.to_arrays()
    assert not found["color"].any()
    np.testing.assert_allclose(found["background"], image.mean(axis=(0, 1)), rtol=1e-6)


def test_splats_all_the_same(backend):
    """As good as one of them, after any number of steps."""
    found = [scene_of(np.full((COUNT, 8), value)) for value in np.linspace(0.3, 0.7, 7)]
    for scene in (scene_of(np.full((COUNT, 8), 0.52654237)), *found):
        *_, best = best_colors(scene.permuted([0]), noise())
        for steps in (3, 40):
            found = solve(scene.on(backend), noise(), steps)
            assert true_error(found, noise()) == pytest.approx(best, rel=1e-4)


def test_a_set_with_derivatives(backend):
    gaussians = random_scene().on(backend)
    dr.enable_grad(gaussians.mean, gaussians.color)
    solution = solve(gaussians, noise(), steps=2)
    assert not dr.grad_enabled(solution.color)
    assert dr.grad_enabled(gaussians.mean)


def test_values_that_all_splats_share(backend):
    scene = random_scene()._replace(factor=np.tile([0.5, 0.25, 0.75], (COUNT, 1)))
    gaussians = scene.on(backend)
    shared = replace(gaussians, factor=type(gaussians.factor)(0.5, 0.25, 0.75))
    check_equal(solve(shared, noise(), 3), solve(gaussians, noise(), 3).to_arrays())


@pytest.mark.parametrize("shape", [(17, 22, 1), (22, 17, 3), (16, 22, 3), (17, 22, 4)])
def test_wrong_shape(backend, shape):
    with pytest.raises(ValueError, match=r"the image has .*, the set \(22, 17, 3\)") as error:
        solve(random_scene().on(backend), np.zeros(shape, np.float32))
    assert "\n" not in str(error.value)


def test_steps_below_0_are_refused(backend):
    with pytest.raises(ValueError, match="steps is -1; it must be at least 0"):
        solve(random_scene().on(backend), noise(), -1)


@pytest.mark.parametrize("cutoff", [0.0, 13.0])
def test_cutoffs_out_of_range_are_refused(backend, cutoff):
    with pytest.raises(ValueError, match="cutoff"):
        solve(replace(random_scene().on(backend), cutoff=cutoff), noise())

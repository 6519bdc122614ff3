"""Random moves of Gaussians, in units of what the image can bear."""

import numpy as np
import pytest

import eigengs_dr as eg
from eigengs_dr.backend.arrays import types_in, upload, upload_rows
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.control import MAX_NOISE, SHAPE_SHARE, perturb

COUNT, SIDE = 4000, 48


def scene(color: float) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    a, c = np.exp(rng.uniform(-2, 0, (2, COUNT)))
    return {
        "mean": rng.uniform(0, SIDE, (COUNT, 2)),
        "factor": np.stack([a, rng.uniform(-0.3, 0.3, COUNT), c], axis=1),
        "color": rng.uniform(-color, color, (COUNT, 3)),
    }


def moves(before, after):
    """Return ``F dm`` and the entries of ``F' F^-1``, in standard deviations."""
    a, b, c = before["factor"].T
    x, y = (after["mean"] - before["mean"]).T
    k, m, n = after["factor"].T
    return np.stack([a * x + b * y, c * y]), np.stack([k / a, (m - k * b / a) / c, n / c])


def perturbed(before, error, strength, seed, movable=range(COUNT), backend="llvm", images=1):
    """The arrays after `perturb`; the error is that of each image."""
    types = types_in(select(backend), 64)
    mean, factor, color = (upload_rows(types.Float, before[k].T) for k in before)
    errors = upload(types.Float, np.broadcast_to(error, images))
    rows = types.Float2(*mean), types.Float3(*factor), color
    after = perturb(*rows, movable, errors, strength, seed, images)
    return {"mean": after[0].numpy().T, "factor": after[1].numpy().T}


def test_each_mean_adds_the_same_error(backend):
    """``|F dm|^2`` has the mean ``2 e^2``, with ``e^2 = strength^2 error / (pi |A|^2)``."""
    before, strength, error = scene(1.0), 0.5, 0.01
    moved, shape = moves(before, perturbed(before, error, strength, 3, backend=backend))
    a, _, c = before["factor"].T
    amplitude = np.square(before["color"]).sum(axis=1) / (a * c)
    e = np.minimum(strength * np.sqrt(error / (np.pi * amplitude)), MAX_NOISE)
    np.testing.assert_allclose((moved / e).std(axis=1), 1, atol=0.05)
    np.testing.assert_allclose((moved / e).mean(axis=1), 0, atol=0.05)
    logs = np.stack([np.log(shape[0]), np.log(shape[2])]) / e
    np.testing.assert_allclose(logs.std(axis=1), SHAPE_SHARE, atol=0.03)
    np.testing.assert_allclose((shape[1] / e).std(), SHAPE_SHARE, atol=0.03)


@pytest.mark.parametrize("color", [0.0, 1e-30, 1e-6])
def test_faint_gaussians_move_by_the_largest_noise(color):
    before = scene(color)
    moved = moves(before, perturbed(before, 0.01, 1.0, 0))[0]
    np.testing.assert_allclose(moved.std(axis=1), MAX_NOISE, rtol=0.05)


def test_a_perfect_image_keeps_its_gaussians():
    before = scene(1.0)
    after = perturbed(before, 0.0, 1.0, 0)
    for name in after:
        np.testing.assert_allclose(after[name], before[name], rtol=1e-12)


def test_the_error_added_to_an_image():
    """One Gaussian far from others adds ``strength^2`` times the error, in the mean."""
    arrays = {
        "mean": np.full((1, 2), SIDE / 2),
        "factor": np.array([[0.25, 0.1, 0.4]]),
        "color": np.array([[0.8, 0.5, 0.2]]),
    }

    def image(mean):
        found = eg.Gaussians.from_arrays(
            mean, arrays["factor"], arrays["color"], size=(SIDE, SIDE), cutoff=6, space="data"
        )
        return eg.render(found).numpy().astype(float)

    strength, error, added, before = 0.3, 0.05, [], image(arrays["mean"])
    for seed in range(200):
        moved = perturbed(arrays, error, strength, seed, movable=range(1))
        added.append(np.square(image(moved["mean"]) - before).sum())
    assert np.mean(added) == pytest.approx(strength**2 * error, rel=0.2)


def test_images_of_a_batch_have_equal_noise():
    """With equal errors and Gaussians: no image changes that of another."""
    before = scene(0.1)
    half = COUNT // 2
    twice = {name: np.concatenate([rows[:half]] * 2) for name, rows in before.items()}
    alone = {name: rows[:half] for name, rows in before.items()}
    one = perturbed(alone, 0.01, 1.0, 5, range(half))
    two = perturbed(twice, 0.01, 1.0, 5, range(half), images=2)
    for name, rows in one.items():
        np.testing.assert_array_equal(two[name], np.concatenate([rows] * 2))

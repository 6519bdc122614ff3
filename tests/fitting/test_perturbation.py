"""Random moves of Gaussians, in units of what the image can bear."""

import numpy as np
import pytest

import eigengs_dr as eg
from eigengs_dr.fitting.density_control import MAX_NOISE, SHAPE_SHARE, perturb

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


def copied(arrays):
    return {name: values.copy() for name, values in arrays.items()}


def test_each_mean_adds_the_same_error():
    """``|F dm|^2`` has the mean ``2 e^2``, with ``e^2 = strength^2 error / (pi |A|^2)``."""
    before, strength, error = scene(1.0), 0.5, 0.01
    after = copied(before)
    perturb(after, np.arange(COUNT), error, strength, seed=3)
    moved, shape = moves(before, after)
    a, _, c = before["factor"].T
    amplitude = np.square(before["color"]).sum(axis=1) / (a * c)
    e = np.minimum(strength * np.sqrt(error / (np.pi * amplitude)), MAX_NOISE)
    np.testing.assert_allclose((moved / e).std(axis=1), 1, atol=0.05)
    np.testing.assert_allclose((moved / e).mean(axis=1), 0, atol=0.05)
    logs = np.stack([np.log(shape[0]), np.log(shape[2])]) / e
    np.testing.assert_allclose(logs.std(axis=1), SHAPE_SHARE, atol=0.03)
    np.testing.assert_allclose((shape[1] / e).std(), SHAPE_SHARE, atol=0.03)
    np.testing.assert_array_equal(after["color"], before["color"])


@pytest.mark.parametrize("color", [0.0, 1e-30, 1e-6])
def test_faint_gaussians_move_by_the_largest_noise(color):
    before = scene(color)
    after = copied(before)
    perturb(after, np.arange(COUNT), 0.01, 1.0, seed=0)
    np.testing.assert_allclose(moves(before, after)[0].std(axis=1), MAX_NOISE, rtol=0.05)


def test_only_the_own_gaussians_move():
    before, own = scene(1.0), np.arange(10, 30)
    after = copied(before)
    perturb(after, own, 0.01, 1.0, seed=0)
    moved = np.flatnonzero((after["mean"] != before["mean"]).any(axis=1))
    np.testing.assert_array_equal(moved, own)


def test_a_perfect_image_keeps_its_gaussians():
    before = scene(1.0)
    after = copied(before)
    perturb(after, np.arange(COUNT), 0.0, 1.0, seed=0)
    for name in before:
        np.testing.assert_allclose(after[name], before[name], rtol=1e-12)


def test_seeds():
    sets = [copied(scene(1.0)) for _ in range(3)]
    for arrays, seed in zip(sets, (1, 1, 2), strict=True):
        perturb(arrays, np.arange(COUNT), 0.01, 1.0, seed)
    assert (sets[0]["mean"] == sets[1]["mean"]).all()
    assert (sets[0]["mean"] != sets[2]["mean"]).any()


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

    strength, error, added = 0.3, 0.05, []
    for seed in range(200):
        moved = copied(arrays)
        perturb(moved, np.arange(1), error, strength, seed)
        added.append(np.square(image(moved["mean"]) - image(arrays["mean"])).sum())
    assert np.mean(added) == pytest.approx(strength**2 * error, rel=0.2)

"""The weights of the model of probabilities."""

import numpy as np
import pytest

from eigengs_dr.codec import weights
from eigengs_dr.codec.weights import CLASSES, Model, Weights, feature_counts, fit_weights
from eigengs_dr.storage.npz import BadValue


def model(channels, rich):
    generator, found = np.random.default_rng(channels), Model()
    for center, width in feature_counts(channels):
        parts = [generator.normal(size=center), generator.uniform(size=width)]
        if not rich:
            parts = [values * (np.arange(len(values)) == 0) for values in parts]
        stored = weights.stored_center(parts[0]), weights.stored_width(parts[1])
        found.weights.append(Weights(*stored, 4))
    found.sharpness = generator.integers(0, 256, CLASSES) * rich
    return found


@pytest.mark.parametrize("rich", [True, False])
@pytest.mark.parametrize("channels", [1, 3, 5])
def test_weights_come_back(channels, rich):
    before = model(channels, rich)
    data = weights.to_bytes(before, rich)
    found, rest = weights.from_bytes(data + b"rest", channels, rich)
    assert rest == b"rest"
    for one, other in zip(found.weights, before.weights, strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(found.sharpness, before.sharpness)
    for length in range(len(data)):
        with pytest.raises(BadValue, match="cut off"):
            weights.from_bytes(data[:length], channels, rich)


def test_the_fit_finds_what_numbers_follow():
    generator = np.random.default_rng(0)
    center = generator.normal(size=(4000, 2))
    width = np.stack([np.ones(4000), generator.uniform(0, 9, 4000)], axis=1)
    noise = generator.standard_t(8, 4000) * (0.5 + width[:, 1])
    step = np.full(4000, 0.1)
    values = np.rint((30 * center[:, 0] + noise) / step) * step
    found = fit_weights(center, width, values, step)
    np.testing.assert_allclose(found.center, [30, 0], atol=0.3)
    assert found.width[1] == pytest.approx(1, rel=0.3)
    plain = fit_weights(center, width, values, step, rich=False)
    assert plain.center[1] == plain.width[1] == 0

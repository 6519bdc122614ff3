"""The probabilities: directions and weights."""

import numpy as np
import pytest

from eigengs_dr.codec.gaussian_model import SECTORS, Directions, passes_of
from eigengs_dr.codec.range_coder import Decoder, Encoder
from eigengs_dr.codec.weights import fit_weights


def coded(turn, turns, length):
    """Return the bits of each direction, which come back."""
    passes = passes_of(np.arange(2 * len(turn)).reshape(-1, 2))
    encoder = Encoder()
    sharpness = Directions(passes, length, turns).fit(turn)
    Directions(passes, length, turns).code(encoder, sharpness, turn)
    decoder = Decoder(encoder.to_bytes())
    found = Directions(passes, length, turns).code(decoder, sharpness, np.zeros_like(turn))
    np.testing.assert_array_equal(found, turn)
    return 8 * len(encoder.to_bytes()) / len(turn)


@pytest.mark.parametrize("most", [1, 2, SECTORS - 1, SECTORS, SECTORS + 1, 1 << 20])
def test_directions_come_back(most):
    generator = np.random.default_rng(most)
    turns = generator.integers(1, most + 1, 300)
    coded(generator.integers(0, turns), turns, generator.uniform(0, 3, 300))


def test_directions_along_an_edge_take_fewer_bits():
    generator = np.random.default_rng(0)
    turns, length = np.full(3000, 64), np.full(3000, 1.2)
    edge = np.rint(20 + 2 * generator.normal(size=3000)).astype(np.int64) % 64
    assert coded(generator.integers(0, 64, 3000), turns, length) < 6.1
    assert coded(edge, turns, length) < 4.5


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

"""The probabilities: directions and weights."""

import numpy as np
import pytest

from eigengs_dr.codec.gaussian_model import SECTORS, Directions, passes_of
from eigengs_dr.codec.range_coder import Decoder, Encoder


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

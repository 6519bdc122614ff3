"""The directions of Gaussians."""

import numpy as np
import pytest

from eigengs_dr.codec.directions import SECTORS, Directions
from eigengs_dr.codec.neighbors import passes_of
from eigengs_dr.codec.range_coder import Decoder, Encoder


def coded(turn, turns, length):
    """Return the bits of each direction, and whether they come back."""
    passes = passes_of(np.arange(2 * len(turn)).reshape(-1, 2))
    encoder = Encoder()
    sharpness = Directions(encoder, passes, length, turns).fit(turn)
    Directions(encoder, passes, length, turns).code(sharpness, turn)
    decoder = Decoder(encoder.to_bytes())
    found = Directions(decoder, passes, length, turns).code(sharpness)
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

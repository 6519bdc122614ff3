"""The probabilities: passes, neighbours and directions."""

import numpy as np
import pytest

from eigengs_dr.codec.gaussian_model import SECTORS, Directions, crowding, passes_of
from eigengs_dr.codec.range_coder import Decoder, Encoder


@pytest.mark.parametrize("count", [1, 2, 9, 16, 17, 100])
def test_passes_hold_all_gaussians_and_know_earlier_ones(count):
    cells, known = np.random.default_rng(0).integers(0, 99, (count, 2)), set()
    for part in passes_of(cells):
        for others, weight in zip(part.known, part.weight, strict=True):
            assert known.issuperset(others[weight > 0])
        if part.weight:
            np.testing.assert_allclose(sum(part.weight), 1)
        assert known.isdisjoint(part.rows)
        known.update(part.rows.tolist())
    assert known == set(range(count))


def test_near_neighbors_weigh_more():
    cells = np.stack([np.arange(4) ** 3, np.zeros(4, int)], axis=1)
    part = passes_of(cells)[-1]
    values = np.array([10.0, 0, 20.0, 0])
    assert part.rows.tolist() == [1, 3]
    assert part.mean(values)[0] == pytest.approx((10 / 2 + 20 / 50) / (1 / 2 + 1 / 50))


def test_crowding_counts_gaussians_in_windows():
    cells = np.array([[0, 0], [1, 1], [0, 1], [90, 90]])
    small, large, near = crowding(cells)
    np.testing.assert_allclose(small, np.log2([3, 3, 3, 1]))
    np.testing.assert_allclose(large, np.log2([3, 3, 3, 1]))
    np.testing.assert_allclose(near, np.log2([3, 2, 2, 90**2 + 89**2 + 1]))


def test_windows_of_far_gaussians_take_little_memory():
    assert len(crowding(np.array([[0, 0], [1 << 23, 1 << 23]]))) == 3


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

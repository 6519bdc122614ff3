"""What is known of the surroundings of Gaussians."""

import numpy as np
import pytest

from eigengs_dr.codec.neighbors import crowding, passes_of


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

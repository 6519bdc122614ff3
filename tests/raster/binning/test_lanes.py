"""The order of lanes."""

import numpy as np

from eigengs_dr.raster.binning.lists import PACKET, order_lanes


def test_windows_keep_neighbours_together():
    """Without empty lanes: by window, then by descending length, equal lengths as they were."""
    window = np.repeat([0, 1, 2], 50)
    length = np.random.default_rng(0).integers(1, 9, 150)
    order = order_lanes(length, window)
    np.testing.assert_array_equal(order, np.lexsort((np.arange(150), -length, window)))


def test_empty_packets_are_dealt_out():
    """Every quarter of the lanes has a quarter of the work."""
    length = np.concatenate([np.full(64 * PACKET, 8), np.zeros(32 * PACKET, int)])
    order = order_lanes(length, np.arange(len(length)) // 256)
    assert sorted(order) == list(range(len(length)))
    work = length[order].reshape(4, -1).sum(axis=1)
    assert np.ptp(work) <= PACKET * 8

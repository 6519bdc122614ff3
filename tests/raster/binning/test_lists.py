"""Pieces of the lists, which are their transpose, and the order of lanes."""

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from _helpers.sets import few, scenes
from _helpers.tile_lists import GRID, RADIUS, upload
from eigengs_dr.raster.binning.lists import PACKET, build_lists, order_lanes
from eigengs_dr.raster.binning.tiles import GRANULARITY, Grid


def pairs_by_splat(lists):
    """The pairs of the pieces as a matrix (tiles, N), and the number of visits of every piece."""
    pieces = lists.pieces
    tile, splat, begin, end = (
        getattr(pieces, k).numpy().astype(int) for k in ("tile", "splat", "begin", "end")
    )
    found = np.zeros((lists.grid.tiles, dr.width(pieces.first)), int)
    for n, i, j in zip(splat, begin, end, strict=True):
        np.add.at(found[:, n], tile[i:j], 1)
    return found, end - begin


def pairs_by_tile(lists, count):
    found = np.zeros((lists.grid.tiles, count), int)
    splat, order = lists.splat.numpy(), lists.order.numpy()
    for t, i, j in zip(order, lists.begin.numpy(), lists.end.numpy(), strict=True):
        np.add.at(found[t], splat[i:j], 1)
    return found


@pytest.mark.parametrize(
    ("side", "count", "most"),
    [(260, 512, "long_visits"), (260, 400, "visits"), (256, 600, "visits")],
    ids=["long", "short", "small"],
)
def test_long_lists_have_longer_pieces(backend, side, count, most):
    """Where enough pieces are left, and not in small images, which go in batches."""
    shape = upload(backend, np.full((count, 2), side / 2), np.tile([1e-4, 0, 1e-4], (count, 1)))
    found, visits = pairs_by_splat(build_lists(shape, RADIUS, Grid(side, side)))
    assert (found == 1).all()
    assert visits.max() == getattr(GRANULARITY[backend], most)


@few
@given(scene=scenes(), pad=st.sampled_from([0.0, 1.5]), growth=st.sampled_from([1.0, 1.3]))
def test_pieces_are_the_transpose(backend, scene, pad, growth):
    """Every pair once in both lists, and no piece longer than the granularity."""
    shape = upload(backend, scene.mean, scene.factor)
    lists = build_lists(shape, RADIUS, GRID, pad, growth)
    found, visits = pairs_by_splat(lists)
    assert found.max(initial=0) <= 1
    np.testing.assert_array_equal(found, pairs_by_tile(lists, len(scene.mean)))
    assert visits.max(initial=0) <= GRANULARITY[backend].visits
    slot, first, number = (
        getattr(lists.pieces, k).numpy().astype(int) for k in ("slot", "first", "number")
    )
    assert sorted(slot) == list(range(len(slot)))
    np.testing.assert_array_equal(first, np.cumsum(number) - number)
    owner = np.repeat(np.arange(len(number)), number)
    splat = np.empty(len(slot), int)
    splat[slot] = lists.pieces.splat.numpy()
    np.testing.assert_array_equal(splat[: len(owner)], owner)


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

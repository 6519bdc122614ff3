"""Pieces of the lists: their transpose, Gaussian by Gaussian."""

import drjit as dr
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from _helpers.sets import few, random_scene, scenes
from _helpers.tile_lists import GRID, RADIUS, upload
from eigengs_dr.raster.binning import tiles as granularity
from eigengs_dr.raster.binning.lists import build_lists
from eigengs_dr.raster.binning.tiles import GRANULARITY


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


def test_long_lists_have_longer_pieces(backend, monkeypatch):
    """The same pairs in fewer pieces, where enough of them are left."""
    scene = random_scene()
    shape = upload(backend, scene.mean, scene.factor)
    few = GRANULARITY[backend]._replace(visits=2, long_visits=5)
    monkeypatch.setitem(GRANULARITY, backend, few)
    short = build_lists(shape, RADIUS, GRID)
    monkeypatch.setattr(granularity, "MIN_PIECES", 1)
    small = build_lists(shape, RADIUS, GRID)
    monkeypatch.setattr(granularity, "SMALL", 0)
    long = build_lists(shape, RADIUS, GRID)
    found, visits = pairs_by_splat(long)
    before, most = pairs_by_splat(short)
    np.testing.assert_array_equal(found, before)
    assert most.max() == 2 and 2 < visits.max() <= 5
    # In small images, which go in batches, the length of the lists changes nothing.
    np.testing.assert_array_equal(pairs_by_splat(small)[1], most)


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

"""Lists of Gaussians: complete and tight, and their pieces, which are the transpose."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from _helpers.sets import COUNT, SIZE, covariances, distances, factors_of, few, scenes
from eigengs_dr.backend.arrays import types_in, upload_rows
from eigengs_dr.backend.selection import select
from eigengs_dr.raster.lists import build_lists
from eigengs_dr.raster.tiles import ON_CPU, ON_GPU, Grid

RADIUS = 3.0

GRID = Grid(*SIZE)

GRANULARITY = {"llvm": ON_CPU, "cuda": ON_GPU}

PIECES = ("splat", "begin", "end", "tile", "slot", "first", "number")

EDGE = 1e-3
"""Relative distance to the cutoff within which rounding may decide."""


def lists_of(backend, mean, factor, grid=GRID, pad=0.0, growth=1.0):
    shape = upload_rows(types_in(select(backend)).Float, (*mean.T, *factor.T))
    return build_lists(shape, RADIUS, grid, pad, growth)


def membership(lists, count=COUNT):
    """Which splat is in the list of which tile, shape (count, ny, nx); checks order and bounds."""
    splat, begin, end, order = (
        v.numpy() for v in (lists.splat, lists.begin, lists.end, lists.order)
    )
    grid = lists.grid
    assert sorted(order) == list(range(grid.tiles))
    member = np.zeros((count, grid.tiles), bool)
    for tile, first, last in zip(order, begin, end, strict=True):
        entries = splat[first:last]
        assert (np.diff(entries.astype(int)) > 0).all()
        member[entries, tile] = True
    assert member.sum() == (end - begin).sum()
    return member.reshape(count, grid.ny, grid.nx)


def touched_by_pixels(distance, grid):
    """Tiles with a pixel centre nearer than the cutoff, shape (count, ny, nx)."""
    (width, height), count = grid.tile, len(distance)
    inside = np.zeros((count, grid.ny * height, grid.nx * width), bool)
    inside[:, : grid.height, : grid.width] = distance <= RADIUS * (1 - EDGE)
    return inside.reshape(count, grid.ny, height, grid.nx, width).any(axis=(2, 4))


def check_lists(backend, mean, factor, grid=GRID):
    """Lists hold every splat with a pixel inside, and few others."""
    member = membership(lists_of(backend, mean, factor, grid), len(mean))
    touched = touched_by_pixels(distances(mean, factor, (grid.width, grid.height)), grid)
    assert not (touched & ~member).any(), np.argwhere(touched & ~member)
    assert (member & ~touched).sum() <= 3 * len(mean)  # few rectangles hold no pixel inside
    return member


@few
@given(scene=scenes())
def test_lists_are_complete_and_tight(backend, scene):
    check_lists(backend, scene.mean, scene.factor)


def needles(rng):
    """Stretched by up to 1:400, at every angle; some with a weak a and a strong b, and bands."""
    variances = (
        np.stack([10 ** rng.uniform(0, 2, COUNT), 10 ** rng.uniform(-1.2, 0, COUNT)], 1) ** 2
    )
    factor = factors_of(covariances(variances, np.linspace(0, np.pi, COUNT)))
    factor[-6:] = [[a, b, c] for a in (0.01, 0.1) for b, c in ((4, 4), (-4, 4), (4, 0.05))]
    factor[-8:-6] = [[1, 1, 1e-25], [1, -1, 1e-25]]  # without end
    return factor.astype(np.float32)


def sub_pixel(rng):
    return rng.uniform([4, -50, 4], 50, (COUNT, 3))


def huge(rng):
    factor = 10 ** rng.uniform(-6, -1, (COUNT, 3))
    factor[:, 1] = rng.uniform(-1e-2, 1e-2, COUNT)
    return factor


@pytest.mark.parametrize("shapes", [needles, sub_pixel, huge])
@pytest.mark.parametrize("spread", [1.0, 3.0])
def test_lists_of_extreme_shapes(backend, shapes, spread):
    rng = np.random.default_rng(0)
    mean = ((rng.uniform(0, 1, (COUNT, 2)) - 0.5) * spread + 0.5) * SIZE
    mean[:4] = np.floor(mean[:4]) + 0.5  # on pixel centres
    mean, factor = mean.astype(np.float32), shapes(rng).astype(np.float32)
    member = check_lists(backend, mean, factor)
    assert member.any()


@pytest.mark.slow
def test_too_many_entries_are_refused(backend):
    count, side = 65537, 1024  # each in all 65536 tiles
    mean, factor = np.full((count, 2), side / 2), np.tile([1e-4, 0, 1e-4], (count, 1))
    with pytest.raises(ValueError, match="65537 Gaussians touch 4295032832 tiles, the limit is"):
        lists_of(backend, mean, factor, Grid(side, side))


@few
@given(scene=scenes(), pad=st.sampled_from([0.0, 1.5]), growth=st.sampled_from([1.0, 1.3]))
def test_pieces_are_the_transpose(backend, scene, pad, growth):
    """Every pair once in both lists, and no piece longer than the granularity."""
    lists = lists_of(backend, scene.mean, scene.factor, pad=pad, growth=growth)
    pieces = {name: getattr(lists.pieces, name).numpy().astype(int) for name in PIECES}
    found = np.zeros((COUNT, GRID.tiles), int)
    for n, first, last in zip(pieces["splat"], pieces["begin"], pieces["end"], strict=True):
        np.add.at(found[n], pieces["tile"][first:last], 1)
    np.testing.assert_array_equal(found.reshape(COUNT, GRID.ny, GRID.nx), membership(lists))
    assert (pieces["end"] - pieces["begin"]).max(initial=0) <= GRANULARITY[backend].visits
    slot, number = pieces["slot"], pieces["number"]
    assert sorted(slot) == list(range(len(slot)))
    np.testing.assert_array_equal(pieces["first"], np.cumsum(number) - number)
    owner = np.repeat(np.arange(len(number)), number)
    splat = np.empty(len(slot), int)
    splat[slot] = pieces["splat"]
    np.testing.assert_array_equal(splat[: len(owner)], owner)

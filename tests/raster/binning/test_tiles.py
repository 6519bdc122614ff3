"""Lists of Gaussians: complete and tight; their pieces, and the order of lanes."""

import tracemalloc

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from _helpers.sets import COUNT, SIZE, covariances, distances, factors_of, few, random_scene, scenes
from eigengs_dr.backend.arrays import types_in, upload_rows
from eigengs_dr.backend.selection import select
from eigengs_dr.raster.binning.lists import PACKET, build_lists, order_lanes
from eigengs_dr.raster.binning.tiles import ON_CPU, ON_GPU, TILE, Grid

RADIUS = 3.0

GRID = Grid(*SIZE)


def upload(backend, mean, factor):
    types = types_in(select(backend))
    return upload_rows(types.Float, (*mean.T, *factor.T))


EDGE = 1e-3
"""Relative distance to the cutoff within which rounding may decide."""


def lists_of(backend, mean, factor, grid=GRID, pad=0.0):
    return build_lists(upload(backend, mean, factor), RADIUS, grid, pad)


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


def least_distance(mean, factor, grid):
    """Least ``|F (x - mean)|`` over the rectangle of a tile's pixel centres, (count, ny, nx).

    The squared distance is convex: its minimum is at the mean or on one of the four sides, where it
    is a parabola.
    """
    a, b, c = (v[:, None, None] for v in np.asarray(factor, np.float64).T)
    left = np.arange(grid.nx) * grid.tile[0] + 0.5 - mean[:, 0, None, None]
    top = (np.arange(grid.ny)[:, None] * grid.tile[1] + 0.5) - mean[:, 1, None, None]
    right, bottom = left + grid.tile[0] - 1, top + grid.tile[1] - 1

    def distance(dx, dy):
        return np.hypot(a * dx + b * dy, c * dy)

    best = np.where((left <= 0) & (right >= 0) & (top <= 0) & (bottom >= 0), 0, np.inf)
    for dy in (top, bottom):  # minimum over dx: a dx + b dy = 0
        best = np.minimum(best, distance(np.clip(-b * dy / a, left, right), dy))
    for dx in (left, right):  # minimum over dy: (b^2 + c^2) dy = -a b dx
        best = np.minimum(best, distance(dx, np.clip(-a * b * dx / (b * b + c * c), top, bottom)))
    return best


def check_lists(backend, mean, factor, grid=GRID):
    """Lists hold every splat with a pixel inside, and none whose ellipse misses the tile."""
    member = membership(lists_of(backend, mean, factor, grid), len(mean))
    missing = touched_by_pixels(distances(mean, factor, (grid.width, grid.height)), grid) & ~member
    assert not missing.any(), np.argwhere(missing)
    excess = member & (least_distance(mean, factor, grid) > RADIUS * (1 + EDGE))
    assert not excess.any(), np.argwhere(excess)
    return member


GRANULARITY = {"llvm": ON_CPU, "cuda": ON_GPU}


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
    return np.stack(
        [rng.uniform(4, 50, COUNT), rng.uniform(-50, 50, COUNT), rng.uniform(4, 50, COUNT)], 1
    )


def huge(rng):
    return np.stack(
        [
            10 ** rng.uniform(-6, -1, COUNT),
            rng.uniform(-1e-2, 1e-2, COUNT),
            10 ** rng.uniform(-6, -1, COUNT),
        ],
        1,
    )


@pytest.mark.parametrize("shapes", [needles, sub_pixel, huge])
@pytest.mark.parametrize("spread", [1.0, 3.0])
def test_lists_of_extreme_shapes(backend, shapes, spread):
    rng = np.random.default_rng(0)
    mean = ((rng.uniform(0, 1, (COUNT, 2)) - 0.5) * spread + 0.5) * SIZE
    mean[:4] = np.floor(mean[:4]) + 0.5  # on pixel centres
    mean, factor = mean.astype(np.float32), shapes(rng).astype(np.float32)
    member = check_lists(backend, mean, factor)
    assert member.any()


@pytest.mark.parametrize(
    ("size", "tile"),
    [
        *((size, TILE) for size in ((1, 1), (1, 9), (9, 1), (8, 4), (5, 5))),
        *((SIZE, tile) for tile in ((1, 1), (8, 8), (3, 5))),
    ],
)
def test_grids(backend, size, tile):
    grid = Grid(*size, tile)
    assert grid.nx == -(-size[0] // tile[0])
    assert grid.tiles == grid.nx * grid.ny
    assert grid.pixels == tile[0] * tile[1]
    scene = random_scene(2)
    check_lists(backend, scene.mean * np.array(size) / SIZE, scene.factor, grid)


@pytest.mark.slow
def test_too_many_entries_are_refused(backend):
    count, side = 65537, 1024  # each in all 65536 tiles
    mean, factor = np.full((count, 2), side / 2), np.tile([1e-4, 0, 1e-4], (count, 1))
    with pytest.raises(ValueError, match="65537 Gaussians touch 4295032832 tiles, the limit is"):
        lists_of(backend, mean, factor, Grid(side, side))


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


def plain_order(length, window):
    """`order_lanes` by a sort of pairs, which takes any numbers."""
    order = np.lexsort((np.arange(len(length)), -length, window))
    dealt = len(order) // PACKET * PACKET
    packets = order[:dealt].reshape(-1, PACKET)
    full = length[packets[:, [0, -1]]].any(axis=1)
    place = np.zeros(len(packets), int)
    for kind in (full, ~full):
        place[kind] = np.linspace(0, 65535, kind.sum()).astype(int)
    packets = packets[np.lexsort((np.arange(len(packets)), place))]
    return np.concatenate([packets.ravel(), order[dealt:]])


@pytest.mark.parametrize("lanes", [1, 16, 100, 5000])
@pytest.mark.parametrize("longest", [0, 1, 40, 100_000])
def test_lanes_are_in_the_order_of_a_plain_sort(lanes, longest):
    """Windows of one run, and windows of tiles, which return row after row."""
    rng = np.random.default_rng(lanes + longest)
    length = np.where(rng.uniform(size=lanes) < 0.6, rng.integers(0, longest + 1, lanes), 0)
    lane = np.arange(lanes)
    for window in (lane // 64, lane % 80 // 32 + 3 * (lane // 800)):
        np.testing.assert_array_equal(order_lanes(length, window), plain_order(length, window))


def test_the_order_of_lanes_takes_the_memory_of_the_lists():
    """Not that of all windows times the longest list: one tile may hold most Gaussians."""
    window = np.arange(64_000) // 32
    length = np.ones(len(window), int)
    length[5] = 20_000
    tracemalloc.start()
    order_lanes(length, window)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100 * len(window)


def test_empty_packets_are_dealt_out():
    """Every quarter of the lanes has a quarter of the work."""
    length = np.concatenate([np.full(64 * PACKET, 8), np.zeros(32 * PACKET, int)])
    order = order_lanes(length, np.arange(len(length)) // 256)
    assert sorted(order) == list(range(len(length)))
    work = length[order].reshape(4, -1).sum(axis=1)
    assert np.ptp(work) <= PACKET * 8

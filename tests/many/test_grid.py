"""Blocks, the Gaussians counts to them, and the rounds of a fit by blocks."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eigengs_dr.fitting.method import DEFAULT
from eigengs_dr.fitting.step import next_build
from eigengs_dr.many.block import exchange_rounds
from eigengs_dr.many.grid import BlockSets, allocate, divide


@given(st.integers(1, 300), st.integers(1, 300), st.integers(20, 120), st.integers(0, 40))
def test_cores_tile_the_image_inside_their_windows(width, height, side, halo):
    covered = np.zeros((height, width), int)
    blocks = divide(width, height, side, halo)
    for number, block in enumerate(blocks):
        assert block.number == number
        covered[block.rows, block.columns] += 1
        window = np.zeros((height, width), int)[block.window_rows, block.window_columns]
        assert window.shape == tuple(block.window_size[::-1])
        assert block.pixels == window[block.core].size
        for core, around, length in (
            (block.rows, block.window_rows, height),
            (block.columns, block.window_columns, width),
        ):
            assert core.stop - core.start <= side
            assert 0 <= around.start <= max(0, core.start - halo)
            assert min(length, core.stop + halo) <= around.stop <= length
    assert (covered == 1).all()
    assert len({tuple(block.window_size) for block in blocks}) == 1


@given(
    st.lists(st.floats(0, 1e3), min_size=1, max_size=20),
    st.integers(0, 2**31),
    st.floats(0, 1),
)
def test_dealt_gaussians_are_all_and_fit(mass, seed, share):
    pixels = np.random.default_rng(seed).integers(1, 50, len(mass))
    count = len(mass) + round(share * (pixels.sum() - len(mass)))
    counts = allocate(np.array(mass), pixels, count)
    assert counts.sum() == count
    assert (counts >= 1).all() and (counts <= pixels).all()


def test_gaussians_follow_the_picture():
    counts = allocate(np.array([1.0, 2.0, 5.0]), np.array([1000, 1000, 1000]), 800)
    assert counts.tolist() == [100, 200, 500]
    # A full block leaves the rest to the others.
    assert allocate(np.array([1.0, 8.0, 1.0]), np.array([100, 100, 100]), 200).tolist() == [
        50,
        100,
        50,
    ]


@pytest.mark.parametrize("iterations", [0, 1, 2, 10, 100, 179, 180, 980, 5000])
def test_rounds_take_every_step_once(iterations):
    parts = exchange_rounds(DEFAULT, iterations)
    assert [step for part in parts for step in part] == list(range(iterations))
    assert len(parts) == 1 or all(parts)
    starts = {part.start for part in parts}
    assert DEFAULT.steps_in("moves", iterations) <= starts  # a round may end with none


def test_rates_rise_from_the_start_of_a_part():
    """By the sums of the rates between builds, which bound how far Gaussians move."""
    factors = DEFAULT.without("places").rate_factors(100)

    def moved(step, since):
        end, moves = next_build(DEFAULT, DEFAULT.drift, factors, step, step + 1, since)
        assert end == step + 1
        return moves["mean"] / (DEFAULT.rates["mean"] * factors[step])

    rise = [moved(step, 40) for step in range(40, 50)]
    np.testing.assert_allclose(rise, [0.2, 0.4, 0.6, 0.8, 1, 1, 1, 1, 1, 1])


def test_a_window_sees_every_gaussian_once():
    """Those whose means lie in it, or others that touch it, wherever their block is."""
    blocks = divide(96, 96, 32, 8)
    rng = np.random.default_rng(3)
    sets = BlockSets(blocks, np.full(9, 20), ("mean", "factor", "color"), cutoff=3.0)
    for block in blocks:
        size = rng.choice([0.5, 12], 20)
        corner = np.array([block.columns.start, block.rows.start])
        own = {
            "mean": corner + rng.uniform(-6, 38, (20, 2)),
            "factor": np.stack([1 / size, 0 * size, 1 / size], axis=1),
            "color": np.full((20, 3), block.number),
        }
        sets.put(block, own | {"mean": own["mean"] - block.corner})
    mean, reach = sets.arrays["mean"], 3 / sets.arrays["factor"][:, :1]
    for block in blocks:
        inside, own = sets.in_window(block)
        outside = sets.around(block)
        seen = np.concatenate([inside["mean"], outside["mean"]]) + block.corner
        low, high = block.corner, block.corner + block.window_size
        touching = ((mean + reach >= low) & (mean - reach <= high)).all(axis=1)
        distance = np.abs(seen[:, None] - mean[None]).max(axis=2)
        assert ((distance < 1e-3).sum(axis=1) == 1).all()
        assert len(set(distance.argmin(axis=1).tolist())) == len(seen)
        assert set(distance.argmin(axis=1)) >= set(np.flatnonzero(touching))
        assert (inside["color"][own] == block.number).all() and own.stop - own.start == 20

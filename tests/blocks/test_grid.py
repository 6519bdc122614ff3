"""Blocks, and the Gaussians dealt to them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from eigengs_dr.blocks.grid import deal, divide


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
    dealt = deal(np.array(mass), pixels, count)
    assert dealt.sum() == count
    assert (dealt >= 1).all() and (dealt <= pixels).all()


def test_gaussians_follow_the_picture():
    dealt = deal(np.array([1.0, 2.0, 5.0]), np.array([1000, 1000, 1000]), 800)
    assert dealt.tolist() == [100, 200, 500]
    # A full block leaves the rest to the others.
    assert deal(np.array([1.0, 8.0, 1.0]), np.array([100, 100, 100]), 200).tolist() == [50, 100, 50]

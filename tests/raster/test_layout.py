"""How parameters of splats lie in memory."""

import drjit as dr
import numpy as np
import pytest

from _helpers.sets import upload
from eigengs_dr.raster.parameters import gather_run, pack_parameters, unpack_parameters


@pytest.mark.parametrize("number", [1, 4, 6, 7, 8, 9])
def test_unpack_returns_what_pack_stored(types, number):
    values = np.random.default_rng(0).normal(size=(number, 50)).astype(np.float32)
    packed = pack_parameters(upload(types, *values))
    assert dr.width(packed) % 4 == 0
    index = np.array([49, 0, 7, 7, 30])
    found = unpack_parameters(packed, types.UInt(index), number)
    assert len(found) == number
    np.testing.assert_array_equal([v.numpy() for v in found], values[:, index])


def test_pack_repeats_values_that_all_splats_share(types):
    packed = pack_parameters([types.Float([1, 2, 3]), types.Float(7)])
    found = unpack_parameters(packed, dr.arange(types.UInt, 3), 2)
    np.testing.assert_array_equal(found[1].numpy(), [7, 7, 7])


@pytest.mark.parametrize("length", [1, 2, 3, 5, 6, 12])
def test_gather_run(types, length):
    source = np.arange(10 * length)
    runs = gather_run(types, types.Float(source), types.UInt([3, 0, 9]), length, True)
    np.testing.assert_array_equal(
        np.stack([r.numpy() for r in runs], 1), source.reshape(10, length)[[3, 0, 9]]
    )


def test_gather_run_reads_nothing_in_inactive_lanes(types):
    runs = gather_run(
        types, types.Float(np.ones(8)), types.UInt([0, 1 << 30]), 4, types.Bool([True, False])
    )
    np.testing.assert_array_equal([r.numpy() for r in runs], [[1, 0]] * 4)

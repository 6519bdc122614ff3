"""The weights of a model on two processes."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import SPLATS, small_basis
from eigengs_dr.backend.executor import ClusterError, Done


@pytest.mark.parametrize("options", [{}, {"frequency_aware": True}, {"iterations": 1}])
def test_the_bits_of_one_process(client, options):
    here = eg.EigenGS.fit(small_basis(), SPLATS, backend="llvm", **options)
    far = eg.EigenGS.fit(small_basis(), SPLATS, backend="llvm", client=client, **options)
    for name, array in here.gaussians.to_arrays().items():
        np.testing.assert_array_equal(far.gaussians.to_arrays()[name], array, name)
    for found, expected in zip(far.weights, here.weights, strict=True):
        np.testing.assert_array_equal(found, expected)
    name = "psnr_components"
    assert far.figures[name] == here.figures[name]


def test_a_group_that_is_lost():
    class Losing:
        workers = 1

        def map(self, function, tasks, shared=None):
            yield Done(0, None, "its worker ended 2 times")

    with pytest.raises(ClusterError, match="a part of the work cannot be done: its worker ended"):
        eg.EigenGS.fit(small_basis(), SPLATS, backend="llvm", client=Losing())

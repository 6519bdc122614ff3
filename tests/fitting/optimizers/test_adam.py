"""Adam, against Dr.Jit's own where that works."""

import drjit as dr
import drjit.opt
import numpy as np
import pytest

from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.optimizers.adam import Adam


@pytest.mark.parametrize("betas", [(0.9, 0.9), (0.9, 0.99)])
def test_adam_is_that_of_drjit_where_that_works(backend, betas):
    """Equal to the last bit, over the step from which on nothing is debiased."""
    Float = select(backend).Float
    settings = {"beta_1": betas[0], "beta_2": betas[1], "epsilon": 1e-12}
    ours, theirs = (kind(0.1, {"x": Float(1, -2)}, **settings) for kind in (Adam, drjit.opt.Adam))
    for first in (0, ours.last - 5):
        for optimizer in (ours, theirs):
            _, *averages = optimizer.state["x"][-1]
            optimizer.state["x"] = *optimizer.state["x"][:-1], (UInt(backend, first), *averages)
        for _ in range(10):
            for optimizer in (ours, theirs):
                dr.backward(dr.square(optimizer["x"]) * Float(1, 3))
                optimizer.step()
            np.testing.assert_array_equal(ours["x"].numpy(), theirs["x"].numpy())


def UInt(backend, value):
    return dr.opaque(select(backend).UInt32, value)


def test_adam_survives_the_steps_at_which_a_power_leaves_the_range_of_doubles(backend):
    """With a beta of 0.9 the steps 6,734 to 6,736: Dr.Jit's own makes all variables NaN."""
    Float = select(backend).Float
    optimizer = Adam(0.1, {"x": Float(1, -2)}, beta_1=0.9, beta_2=0.9, epsilon=1e-12)
    for t in range(6700, 6760):
        _, *averages = optimizer.state["x"][-1]
        optimizer.state["x"] = *optimizer.state["x"][:-1], (UInt(backend, t), *averages)
        dr.backward(optimizer["x"] * Float(3, -4))
        optimizer.step()
    # Averages that start at 0 and are not debiased hold a share of 1 - 0.9^k of a steady gradient.
    moved = 0.1 * sum(np.sqrt(1 - 0.9**k) for k in range(1, 61))
    np.testing.assert_allclose(optimizer["x"].numpy(), [1 - moved, -2 + moved], rtol=1e-4)


def test_adam_refuses_averages_of_which_one_outlives_the_range_of_the_other():
    with pytest.raises(ValueError, match="closer to each other"):
        Adam(0.1, beta_1=0.9, beta_2=0.999)

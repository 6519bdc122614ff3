"""The colour solve with a background that is given."""

import numpy as np

import eigengs_dr as eg
from _helpers.photos import coffee
from eigengs_dr.fitting.placement.adaptive import place_adaptive
from eigengs_dr.fitting.solvers.conjugate_gradient import solve
from eigengs_dr.fitting.target import make_target


def test_background_stays(backend):
    target = make_target(coffee(48), "ycbcr").values
    mean, factor = place_adaptive(target, 150)
    start = eg.Gaussians.from_arrays(
        mean, factor, np.zeros((150, 3)), size=(48, 48), backend=backend
    )
    given = np.array([0.2, 0.5, 0.6], np.float32)
    held = solve(start, target, 40, background=given)
    np.testing.assert_array_equal(held.gaussians.to_arrays()["background"], given)
    free = solve(start, target, 40)
    assert free.residuals[-1] <= held.residuals[-1] < 0.5 * held.residuals[0]

"""Splats that move to where the error is."""

from dataclasses import replace

import numpy as np
import pytest

from _helpers.halves import SIDE, fitted, picture
from eigengs_dr.fitting.options import PRESETS, FitOptions
from eigengs_dr.fitting.placement.adaptive import redistribute
from eigengs_dr.fitting.schedule import first_phase
from eigengs_dr.fitting.start import initialize
from eigengs_dr.raster.render import render


@pytest.mark.parametrize("side", [32, 150])
def test_rearranged_has_the_count_and_goes_where_the_error_is(side):
    """Also where splats are so far apart that they are placed on a smaller image."""
    image = np.kron(picture(), np.ones((-(-side // SIDE), -(-side // SIDE), 1)))[:side, :side]
    start = initialize(image.astype(np.float32), FitOptions(gaussians=64, init="grid"))
    result = redistribute(start.gaussians, 50, start.target, start.target)
    left = result.mean.numpy()[0] < side / 2
    assert len(result) == 50
    assert left.mean() > 0.6  # half of the area, most of the error
    assert np.isfinite(render(result).numpy()).all()


def test_weights_draw_splats():
    start, target = fitted()
    weight = np.ones_like(target)
    weight[SIDE // 2 :] = 1e-3
    result = redistribute(start.gaussians, 60, target, target, weight)
    assert (result.mean.numpy()[1] < SIDE / 2).mean() > 0.7


def test_the_first_phase_is_a_tenth_of_a_short_descent():
    schedule = PRESETS["default"].schedule
    steps = (0, 99, 100, 150, 200, 100_000)
    assert [first_phase(schedule, n) for n in steps] == [0, 0, 10, 15, 20, 20]
    assert first_phase(replace(schedule, redistribute_after=0), 1000) == 0

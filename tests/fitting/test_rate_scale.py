"""Rates that fall with the colour of a Gaussian."""

from dataclasses import replace

import numpy as np
import pytest

from _helpers.sets import random_scene
from eigengs_dr.fitting.descent import start_descent
from eigengs_dr.fitting.options import PRESETS
from eigengs_dr.fitting.schedule import MAX_RATE_SCALE, rate_scale_of


def test_rates_fall_with_the_root_of_the_colour():
    color = np.array([[[0.3, 0.4, 0.0], [0.0, 0.0, 1.0], [-1.5, 0.0, 0.0]]])  # 0.5, 1 and 1.5
    np.testing.assert_allclose(rate_scale_of(color, 0.5), [[2**0.5, 1, 1.5**-0.5]], rtol=1e-6)


def test_bounds():
    color = np.array([[[0.0], [1e-30], [1.0], [1e6]]])
    fastest, slowest = MAX_RATE_SCALE, 1 / MAX_RATE_SCALE
    expected = [[fastest, fastest, fastest, slowest]]
    np.testing.assert_allclose(rate_scale_of(color, 0.5), expected, rtol=1e-6)


def test_no_colours_no_difference():
    np.testing.assert_array_equal(rate_scale_of(np.zeros((2, 3, 4)), 0.5), np.ones((2, 3)))


@pytest.mark.parametrize("unit", [1e-3, 50.0])
def test_the_unit_of_colours_does_not_matter(unit):
    color = np.random.default_rng(0).normal(size=(2, 20, 3))
    np.testing.assert_allclose(
        rate_scale_of(unit * color, 0.5), rate_scale_of(color, 0.5), rtol=1e-6
    )


def test_sets_of_a_batch_are_for_themselves():
    color = np.random.default_rng(0).normal(size=(2, 20, 3)) * [[[1.0]], [[9.0]]]
    alone = [rate_scale_of(part[None], 0.5)[0] for part in color]
    np.testing.assert_array_equal(rate_scale_of(color, 0.5), alone)


def test_a_descent_starts_with_the_factors_of_its_set(backend):
    gaussians, schedule = random_scene().on(backend), PRESETS["default"].schedule
    found = start_descent(gaussians, schedule).rate_scale.numpy()
    color = gaussians.to_arrays()["color"]
    np.testing.assert_array_equal(found, rate_scale_of(color[None], schedule.rate_exponent)[0])
    assert start_descent(gaussians, replace(schedule, rate_exponent=0.0)).rate_scale is None

"""Rates that fall with the colour of a Gaussian."""

from dataclasses import replace

import numpy as np
import pytest

from _helpers.sets import random_scene
from eigengs_dr.backend.arrays import types_in, upload_rows
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.descent import MAX_RATE_SCALE, rate_scale_of, start_descent
from eigengs_dr.fitting.options import PRESETS


def factors(color, exponent=0.5, backend="llvm"):
    """Factors (M, N) of the Gaussians of M images, for colours (M, N, C)."""
    types = types_in(select(backend), 64)
    rows = upload_rows(types.Float, color.reshape(-1, color.shape[2]).T)
    return rate_scale_of(rows, exponent, len(color)).numpy().reshape(color.shape[:2])


@pytest.mark.parametrize(
    ("color", "expected"),
    [
        ([[0.3, 0.4, 0.0], [0.0, 0.0, 1.0], [-1.5, 0.0, 0.0]], [2**0.5, 1, 1.5**-0.5]),
        ([[0.0], [1e-30], [1.0], [1e6]], [MAX_RATE_SCALE] * 3 + [1 / MAX_RATE_SCALE]),
        ([[0.0], [0.0]], [1, 1]),
    ],
)
def test_rates_fall_with_the_root_of_the_colour(backend, color, expected):
    """Within bounds, and unless there is no colour at all."""
    np.testing.assert_allclose(factors(np.array([color]), backend=backend), [expected], rtol=1e-6)


@pytest.mark.parametrize("unit", [1e-3, 50.0])
def test_the_unit_of_colours_does_not_matter(unit):
    color = np.random.default_rng(0).normal(size=(2, 20, 3))
    np.testing.assert_allclose(factors(unit * color), factors(color), rtol=1e-6)


def test_a_descent_starts_with_the_factors_of_its_set(backend):
    gaussians, schedule = random_scene().on(backend), PRESETS["default"].schedule
    found = start_descent(gaussians, schedule).rate_scale.numpy()
    color = gaussians.to_arrays()["color"].astype(np.float64)
    expected = factors(color[None], schedule.rate_exponent)[0]
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert start_descent(gaussians, replace(schedule, rate_exponent=0.0)).rate_scale is None

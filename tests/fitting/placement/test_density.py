"""The density that an error asks for."""

import numpy as np
import pytest

from eigengs_dr.fitting.placement.density import (
    ERROR_EXPONENT,
    target_density,
)


def squares(side):
    """Centres of squares of 5 x 5 pixels."""
    y, x = np.mgrid[2.5:side:5, 2.5:side:5]
    return np.stack([x.ravel(), y.ravel()], axis=1)


def test_equal_shares_of_error_leave_the_density_as_it_was():
    """Splats on a grid, each with the same error: nothing is gained by moving any."""
    density = target_density(squares(30), np.ones((30, 30)), np.ones((30, 30)))
    np.testing.assert_allclose(density, density.mean(dtype=float), rtol=1e-6)


@pytest.mark.parametrize("times", [0.1, 10.0, 100.0])
def test_density_follows_the_error_by_its_power(times):
    """Far from the border of two halves, densities differ by ``times^(1 / (FALL + 1))``."""
    error = np.ones((60, 60))
    error[:, 30:] = times
    density = target_density(squares(60), error, np.ones((60, 60)))
    ratio = density[:, 50:].mean() / density[:, :10].mean()
    np.testing.assert_allclose(ratio, times ** (1 / (ERROR_EXPONENT + 1)), rtol=1e-6)


def test_that_power_leaves_the_least_error():
    """Of all powers of the error, it is the one whose density misses least: a numerical check."""
    share, tried = np.array([1.0, 30.0]), np.array([0.5, 0.5])
    factor = share * tried**ERROR_EXPONENT * tried  # e = factor rho^-FALL on two equal areas

    def error(power):
        density = tried * share**power
        return (factor * (density / density.sum()) ** -ERROR_EXPONENT).sum()

    powers = np.linspace(0, 1, 2001)
    best = powers[np.argmin([error(p) for p in powers])]
    assert best == pytest.approx(1 / (ERROR_EXPONENT + 1), abs=1e-3)


def test_among_neighbours_density_follows_the_bending():
    mean = np.array([[8.0, 16.0], [24.0, 16.0]])
    bending = np.ones((32, 32))
    bending[:, 4:8] = 5
    density = target_density(mean, np.ones((32, 32)), bending)
    np.testing.assert_allclose(density / density[0, 0], bending, rtol=1e-6)


def test_nothing_missed_and_nothing_bent_is_still_a_density():
    density = target_density(np.array([[5.0, 5.0]]), np.zeros((8, 8)), np.full((8, 8), 1e-30))
    assert np.isfinite(density).all() and (density > 0).all()

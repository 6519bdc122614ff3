"""The peaks of a residual."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eigengs_dr.fitting.placement import density as peaks
from eigengs_dr.fitting.placement.density import SUPPRESSION_RADIUS, residual_peaks


@pytest.mark.parametrize("deviation", [6.0, 1.5, 0.6])
def test_gain_of_a_place_is_what_a_splat_takes(deviation):
    """Of a residual that is one round splat of a tried size, also where it is below a pixel."""
    y, x = np.indices((64, 64)) + 0.5
    splat = 0.7 * np.exp(-((x - 32.5) ** 2 + (y - 30.5) ** 2) / (2 * deviation**2))
    mean, size, color = residual_peaks(splat[..., None], 1, deviation)
    np.testing.assert_allclose(mean, [[32.5, 30.5]])
    np.testing.assert_allclose(size, [deviation])
    np.testing.assert_allclose(color, [[0.7]], rtol=0.01)


@given(st.integers(0, 40))
def test_places_keep_apart_and_never_exceed(count):
    missed = np.random.default_rng(count).normal(size=(24, 20, 3))
    mean, size, color = residual_peaks(missed, count, 4.0)
    assert len(mean) == len(size) == len(color) <= count
    for k in range(len(mean)):
        away = np.abs(mean[k + 1 :] - mean[k]).max(axis=1)
        assert (away > np.ceil(SUPPRESSION_RADIUS * size[k])).all()


def test_places_are_those_of_one_loop_over_all_maxima(monkeypatch):
    """Batches and rounds change nothing, also where a suppressed place would suppress others."""
    rng = np.random.default_rng(0)
    row, column = rng.integers(0, 60, 900), rng.integers(0, 80, 900)
    reach = rng.choice([1, 3, 7], 900)
    free, expected = np.ones((60, 80), bool), []
    for k, (y, x, r) in enumerate(zip(row, column, reach, strict=True)):
        if free[y, x]:
            expected.append(k)
            free[max(0, y - r) : y + r + 1, max(0, x - r) : x + r + 1] = False
    monkeypatch.setattr(peaks, "BATCH", 100)
    for count in (0, 1, 17, len(expected), 900):
        found = peaks._keep_apart(row, column, reach, count, (60, 80))
        np.testing.assert_array_equal(found, expected[:count])


def test_places_of_a_residual_in_strips(monkeypatch):
    missed = np.random.default_rng(1).normal(size=(50, 30, 3)).astype(np.float32)
    weight = np.linspace(0, 1, 50, dtype=np.float32)[:, None, None] * np.ones_like(missed)
    for factor in (None, weight):
        expected = residual_peaks(missed, 40, 2.5, factor)
        with monkeypatch.context() as patch:
            patch.setattr("eigengs_dr.image.strips.STRIP_PIXELS", 200)
            found = residual_peaks(missed, 40, 2.5, factor)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_array_equal(a, b)

"""Footprints: bounded covariances, and the error function."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import erf

from _helpers.sets import covariances, few
from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.raster.lookup.footprint import MAX_FOOTPRINT, bound_covariance, quick_erf


class TestBoundedCovariance:
    def bounded(self, backend, metrics):
        Float = types_in(select(backend)).Float
        rows = [Float(np.asarray(m, np.float32)) for m in np.array(metrics).T.copy()]
        covariance, blind = bound_covariance(rows)
        return np.stack([np.array(c) for c in covariance], 1), np.array(blind)

    @few
    @given(
        long=st.floats(0.001, 100),
        short=st.floats(0.001, 100),
        angle=st.floats(0, 3),
    )
    def test_inverts_and_shortens(self, backend, long, short, angle):
        axes = covariances(np.array([[1.0, 0.0]]), np.array([angle]))[0]
        other = np.eye(2) - axes
        metric = axes / long**2 + other / short**2
        expected = axes * min(long, MAX_FOOTPRINT) ** 2 + other * min(short, MAX_FOOTPRINT) ** 2
        found, blind = self.bounded(backend, [[metric[0, 0], metric[0, 1], metric[1, 1]]])
        if min(long, short) > MAX_FOOTPRINT * 1.001:
            assert blind[0]
        elif min(long, short) < MAX_FOOTPRINT / 1.001:
            assert not blind[0]
            keys = ((0, 0), (0, 1), (1, 1))
            np.testing.assert_allclose(found[0], [expected[k] for k in keys], atol=2e-3)

    def test_what_is_not_finite_is_blind(self, backend):
        found, blind = self.bounded(
            backend, [[np.nan, 0, 1], [np.inf, 0, np.inf], [0, 0, 0], [1, np.nan, 1]]
        )
        assert blind.all()
        assert np.isfinite(found).all()


def test_quick_erf_is_close(backend):
    x = np.linspace(-6, 6, 2001, dtype=np.float32)
    found = np.array(quick_erf(types_in(select(backend)).Float(x)))
    np.testing.assert_allclose(found, erf(x), atol=0.0055)
    assert np.abs(found).max() <= 1 + 1e-6

"""The smoothest target that cameras take for the image."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter, laplace

from _helpers.sets import few

pytest.importorskip("mitsuba", reason="the scenes need mitsuba")

from _helpers.poster import blocks, photo
from eigengs_dr.scene.target import _blur_by, back_project, extrapolate
from eigengs_dr.scene.visibility import Visibility

pytestmark = pytest.mark.mitsuba


class TestTarget:
    @few
    @given(st.integers(0, 100), st.floats(0, 0.9))
    def test_what_is_not_seen_is_filled_from_what_is(self, seed, hidden):
        generator = np.random.default_rng(seed)
        values = generator.uniform(0.2, 0.8, (20, 13, 3)).astype(np.float32)
        seen = generator.uniform(size=(20, 13)) >= hidden
        seen[3, 4] = True
        found = extrapolate(np.where(seen[..., None], values, np.float32(1e6)), seen)
        np.testing.assert_array_equal(found[seen], values[seen])
        low, high = values[seen].min(axis=0), values[seen].max(axis=0)
        assert (found >= low - 1e-3).all() and (found <= high + 1e-3).all()

    def test_filling_is_smooth(self):
        values = photo(64)
        seen = np.zeros((64, 64), bool)
        seen[:, :20] = True
        bend = np.abs(laplace(extrapolate(values, seen).mean(axis=2)))
        assert bend[:, 24:].max() < 0.05 < np.abs(laplace(values.mean(axis=2)))[:, 24:].max()

    def test_an_uneven_blur_is_each_in_its_place(self):
        image, deviation = photo(), np.full((48, 48), np.inf)
        deviation[:, :16], deviation[:, 16:32] = 1.0, 5.0
        found = _blur_by(deviation)(image)
        for columns, sigma in ((slice(0, 16), 1.0), (slice(32, 48), 5.0)):
            expected = gaussian_filter(image, (sigma, sigma, 0), mode="nearest")
            np.testing.assert_allclose(found[:, columns], expected[:, columns], atol=0.01)
        np.testing.assert_allclose(_blur_by(deviation)(np.ones_like(image)), 1, atol=1e-5)

    def test_cameras_take_it_for_the_image(self):
        image = photo()
        rows = blocks(48, 6)
        found = Visibility(np.full((48, 48), 2.4, np.float32), [rows])
        target = back_project(image, found, 1.0)
        blurred = gaussian_filter(image, (2.4, 2.4, 0), mode="nearest")

        def missed(t):
            return np.sqrt(np.mean((rows @ (t - image).reshape(-1, 3)) ** 2))

        def bend(t):
            return np.sqrt(np.mean(laplace(t.mean(axis=2)) ** 2))

        assert missed(target) < 0.2 * missed(blurred)
        assert bend(target) < 0.2 * bend(image)
        assert target.min() >= 0 and target.max() <= 1

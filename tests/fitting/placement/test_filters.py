"""Filters of images in tile layout, beside those of NumPy and SciPy."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from _helpers.plain_placement import plain_blur, plain_squared_hessian, to_canvas, to_pixels
from _helpers.sets import few
from eigengs_dr.fitting.placement.filters import smoothed, squared_hessian

sizes = st.tuples(st.integers(1, 30), st.integers(1, 30), st.sampled_from([1, 3]))


def noise(shape, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, shape)


@few
@given(shape=sizes, deviation=st.floats(0.14, 7))
def test_blur_is_that_of_scipy(backend, shape, deviation):
    """Also with weights wider than the image."""
    image = noise(shape)
    canvas, values = to_canvas(image, backend)
    found = to_pixels(canvas, smoothed(canvas, values, deviation)).reshape(shape)
    np.testing.assert_allclose(found, plain_blur(image, deviation), atol=1e-6)


@few
@given(shape=sizes)
def test_squared_hessian_is_that_of_numpy(backend, shape):
    image = noise(shape)
    canvas, values = to_canvas(image, backend)
    energy, trace = squared_hessian(canvas, values, 0.1)
    expected = plain_squared_hessian(image, 0.1)
    np.testing.assert_allclose(to_pixels(canvas, energy), expected, atol=2e-5)
    np.testing.assert_allclose(to_pixels(canvas, trace), expected[..., :2].sum(axis=2), atol=2e-5)


def test_second_derivatives_of_a_parabola(backend):
    """2 and 6 along the axes, 1 across: H H."""
    y, x = np.indices((30, 40))
    canvas, values = to_canvas((x * x + 3 * y * y + x * y)[..., None] / 64, backend)
    energy, _ = squared_hessian(canvas, smoothed(canvas, values, 0.7), 0.0)
    hessian = np.array([[2.0, 1], [1, 6]]) / 64
    squared = hessian @ hessian
    expected = [squared[0, 0], squared[1, 1], squared[0, 1]]
    inner = to_pixels(canvas, energy)[10:20, 10:30]
    np.testing.assert_allclose(inner, np.broadcast_to(expected, inner.shape), rtol=2e-2)

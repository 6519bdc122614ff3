"""The bounds of parameters."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from _helpers.sets import COUNT, SIZE, arrays_of, check_equal, few, random_scene
from eigengs_dr.gaussian.gaussians import MIN_DEVIATION

LOW, HIGH = 1 / (2 * max(SIZE)), 1 / MIN_DEVIATION
"""Bounds of the diagonal of a factor."""

any_floats = st.floats(width=32, allow_nan=True, allow_infinity=True)


def unbounded(backend, values):
    """A set with any numbers: values has shape (COUNT, 8)."""
    scene = random_scene()._replace(mean=values[:, :2], factor=values[:, 2:5], color=values[:, 5:])
    return scene.on(backend)


def check_bounds(arrays):
    mean, factor = arrays["mean"], arrays["factor"].astype(np.float64)
    assert ((mean >= 0) & (mean <= SIZE)).all()
    a, b, c = factor.T
    for diagonal in (a, c):
        assert ((diagonal >= LOW * (1 - 1e-6)) & (diagonal <= HIGH)).all()
    assert (np.abs(b) <= HIGH).all()
    assert np.isfinite(arrays["color"]).all()
    inverse = np.array([[a * a, a * b], [a * b, b * b + c * c]]).transpose(2, 0, 1)
    assert (np.linalg.det(inverse) > 0).all()


@few
@given(values=hnp.arrays(np.float32, (COUNT, 8), elements=any_floats))
def test_bounds_hold_after_any_step(backend, values):
    bounded = unbounded(backend, values).bounded()
    check_bounds(bounded.to_arrays())
    check_equal(bounded.bounded(), bounded.to_arrays())


def test_bounds_leave_alone_what_is_inside(backend):
    scene = random_scene()
    scene = scene._replace(mean=np.clip(scene.mean, 0, SIZE))
    check_equal(scene.on(backend).bounded(), arrays_of(scene))


def test_what_replaces_numbers_that_are_not_finite(backend):
    """A mean by the middle, a factor by its bound, a colour by 0."""
    for value in (np.nan, np.inf, -np.inf):
        found = unbounded(backend, np.full((COUNT, 8), value)).bounded().to_arrays()
        np.testing.assert_array_equal(found["mean"][0], [SIZE[0] / 2, SIZE[1] / 2])
        np.testing.assert_array_equal(found["factor"][0], [HIGH, 0, HIGH])
        assert not found["color"].any()
    scene = random_scene(size=(1, 1))._replace(background=np.array([np.nan, 0, np.inf]))
    smallest = scene.on(backend).bounded().to_arrays()
    assert np.isfinite(smallest["background"]).all()
    assert ((smallest["mean"] >= 0) & (smallest["mean"] <= 1)).all()
    assert smallest["factor"][:, [0, 2]].min() >= 0.5

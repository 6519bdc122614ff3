"""Spaces: from pixels to values and back, for NumPy and Dr.Jit by the same lines."""

import drjit as dr
import numpy as np
import pytest

from eigengs_dr.image.space import LOG, NORMAL, RADIANCE, SPACES, Extent

SIZE = 8, 9, 3


def pixels_of(space):
    """Pixels that a space can hold: unit vectors for normals, light above 1 where it may be."""
    largest = 1.0 if space.bounded else 3.0
    pixels = np.random.default_rng(3).uniform(0.05, largest, SIZE)
    return space.decode_image(pixels) if space is NORMAL else pixels


@pytest.mark.parametrize("space", SPACES)
def test_values_show_their_pixels(space):
    pixels = pixels_of(space)
    shown = space.display_sums(space.values_of(pixels))
    np.testing.assert_allclose(shown, pixels, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("space", [space for space in SPACES if space is not NORMAL])
def test_the_slope_of_light_is_a_finite_difference(space):
    values, step = np.linspace(0.01, 0.9, 50), 1e-6
    ends = [space.to_light(values + sign * step) for sign in (-1, 1)]
    slope = np.broadcast_to(space.slope(values), values.shape)
    np.testing.assert_allclose(slope, (ends[1] - ends[0]) / (2 * step), rtol=1e-6)


def test_units_are_those_of_the_values():
    values = np.random.default_rng(0).uniform(2, 6, SIZE).astype(np.float32)
    unit = LOG.unit(Extent.of(values))
    assert unit.scale == pytest.approx(np.ptp(values)) and unit.offset == pytest.approx(
        values.mean()
    )
    assert RADIANCE.unit(Extent.of(values)).scale == pytest.approx(values.mean() / 0.18, rel=1e-5)


def short(side=6):
    """Codes of vectors that are shorter or longer than 1."""
    return np.random.default_rng(0).uniform(0, 1, (side, side, 3))


@pytest.mark.parametrize("mode", ["backward", "forward"])
def test_derivatives_of_the_length(backend, mode):
    Tensor = getattr(dr, backend).ad.TensorXf64
    random = np.random.default_rng(0)
    along, weight, step = random.normal(size=(6, 6, 3)), random.normal(size=(6, 6, 3)), 1e-6
    sides = [np.sum(weight * NORMAL.decode_image(short() + d * along)) for d in (-step, step)]
    expected = (sides[1] - sides[0]) / (2 * step)
    x = Tensor(short())
    dr.enable_grad(x)
    y = NORMAL.decode_image(x)
    if mode == "backward":
        dr.backward(dr.sum(y * Tensor(weight), axis=None))
        found = np.sum(dr.grad(x).numpy() * along)
    else:
        dr.set_grad(x, Tensor(along))
        dr.forward_to(y)
        found = np.sum(dr.grad(y).numpy() * weight)
    np.testing.assert_allclose(found, expected, rtol=1e-6)

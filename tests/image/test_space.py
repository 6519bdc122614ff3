"""Spaces: from pixels to values and back, for NumPy and Dr.Jit by the same lines."""

import copy
import pickle
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Float64

import eigengs_dr as eg
from eigengs_dr.image.space import LOG, NORMAL, RADIANCE, SPACES, Extent, space_of

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


@pytest.mark.parametrize("space", SPACES)
def test_values_are_decoded_alike_by_numpy_and_drjit(space):
    values = space.values_of(pixels_of(space)).reshape(-1, 3).T
    expected = space.decode(list(values))
    decoded = space.decode([Float64(row) for row in values])
    for row, other in zip(decoded, expected, strict=True):
        np.testing.assert_allclose(row.numpy(), other, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("space", [space for space in SPACES if space is not NORMAL])
def test_the_slope_of_light_is_a_finite_difference(space):
    values, step = np.linspace(0.01, 0.9, 50), 1e-6
    ends = [space.to_light(values + sign * step) for sign in (-1, 1)]
    slope = np.broadcast_to(space.slope(values), values.shape)
    np.testing.assert_allclose(slope, (ends[1] - ends[0]) / (2 * step), rtol=1e-6)


@pytest.mark.parametrize("space", SPACES)
def test_a_texture_clamps_and_passes_derivatives_on(space):
    values = Float64(-0.2, 0.4, 1.3)
    dr.enable_grad(values)
    shown = space.to_lights([values] * 3)[0]
    if space is not NORMAL:
        assert shown[0] == 0
    if space.bounded:
        assert shown[2] <= 1
    dr.backward(dr.sum(shown))
    assert (np.abs(dr.grad(values).numpy()) > 0).all()


@pytest.mark.parametrize("space", SPACES)
def test_a_space_is_its_name_everywhere(space):
    assert space_of(str(space)) is space
    assert pickle.loads(pickle.dumps(space)) is copy.deepcopy(space) is space
    assert f"{space}" == space and repr(space) == repr(str(space))


@pytest.mark.parametrize("name", ["hsv", 3, None, b"linear", ["linear"]])
def test_unknown_names_are_refused(name):
    with pytest.raises(ValueError, match="is unknown; use one of ycbcr, rgb, linear"):
        space_of(name)


def test_light_above_white_has_a_space_without_an_end():
    spaces = {str(space): str(space.above_white) for space in SPACES}
    assert spaces == {
        "ycbcr": "log",
        "rgb": "log",
        "linear": "radiance",
        "data": "data",
        "radiance": "radiance",
        "log": "log",
        "normal": "normal",
    }


@pytest.mark.parametrize("space", SPACES)
def test_a_packed_file_keeps_errors_small_in_the_space_that_it_names(space):
    values = np.linspace(0.01, 0.9, 9).reshape(1, 3, 3)
    names = {"linear": "sRGB", "radiance": "PU21"}
    assert space.comparable_name == names.get(str(space), f"psnr in {space}")
    assert np.array_equal(space.comparable(values), values) == (str(space) not in names)


def test_units_are_those_of_the_values():
    values = np.random.default_rng(0).uniform(2, 6, SIZE).astype(np.float32)
    unit = LOG.unit(Extent.of(values))
    assert unit.scale == pytest.approx(np.ptp(values)) and unit.offset == pytest.approx(
        values.mean()
    )
    assert RADIANCE.unit(Extent.of(values)).scale == pytest.approx(values.mean() / 0.18, rel=1e-5)


def test_a_set_takes_a_name_and_has_a_space():
    arrays = {"mean": [[2, 2]], "factor": [[1, 0, 1]], "color": [[1, 1, 1]]}
    gaussians = eg.Gaussians.from_arrays(**arrays, size=(4, 4), space="linear")
    assert gaussians.space.is_light and gaussians.space == "linear"
    assert replace(gaussians, space="rgb").space.encoding == "srgb"

"""Fits in every space of colours, of data in any unit, and of light above 1."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.errors import one_line
from _helpers.families import small_model
from _helpers.light import to_coded, to_linear
from _helpers.waves import SPLATS, check_sound, figures, methods, picture


def fit(image, gaussians=SPLATS, iterations=60, **options):
    return eg.fit(image, gaussians, iterations, **options)


def mse(a, b):
    return np.mean(np.square(np.subtract(a, b, dtype=np.float64)))


# --- Colours ------------------------------------------------------------------------------------


@pytest.mark.parametrize("space", ["ycbcr", "rgb", "linear", "data"])
def test_psnrs_are_those_of_the_picture(space, backend):
    result = fit(picture(), space=space, backend=backend)
    assert result.gaussians.space == space
    first = "data" if space == "data" else "ycbcr"
    assert result.psnr_ycbcr == pytest.approx(eg.psnr(picture(), result.image, first), abs=1e-3)
    assert result.psnr_rgb == pytest.approx(eg.psnr(picture(), result.image, "rgb"), abs=1e-3)
    assert result.psnr_rgb > 25
    if space != "data":
        check_sound(result, picture())


def test_linear_light():
    """The sum is linear light, and its picture sRGB; it places by what one sees."""
    result = fit(picture(), space="linear")
    light = eg.render(result.gaussians).numpy()
    np.testing.assert_allclose(result.image, to_coded(np.maximum(light, 0)), atol=1e-6)
    assert mse(light, to_linear(picture())) < 10**-2.5 < mse(light, picture())
    placed = [
        fit(picture(), iterations=0, space=s).gaussians.to_arrays() for s in ("linear", "rgb")
    ]
    np.testing.assert_array_equal(placed[0]["mean"], placed[1]["mean"])
    np.testing.assert_array_equal(placed[0]["factor"], placed[1]["factor"])


def test_linear_light_weighs_errors_as_they_show():
    """Of equal noise in two halves, codes of the dark one are met as well as in the bright one."""
    noise = np.random.default_rng(0).uniform(-0.05, 0.05, (32, 32, 3))
    image = 0.25 + noise
    image[:, 16:] += 0.5
    errors = np.square(fit(image, 200, 100, space="linear").image - image)
    assert 0.4 < errors[:, :16].mean() / errors[:, 16:].mean() < 2.5


@methods
@pytest.mark.parametrize("channels", [1, 3])
def test_data_is_taken_as_it_is(method, channels, backend):
    data = picture()[..., :channels]
    options = {"method": method, "space": "data", "backend": backend}
    if method.needs_model:
        with pytest.raises(ValueError, match="space is 'data', but the start is in 'ycbcr'; use"):
            fit(data, start=small_model(backend), **options)
        return
    result = fit(data, **options)
    assert result.gaussians.space == "data"
    assert result.gaussians.channels == channels
    np.testing.assert_array_equal(result.image, eg.render(result.gaussians).numpy())
    assert figures(result)[-1] > figures(result)[0] + 1


def test_two_channels_are_data():
    """Such as x and y of normals."""
    image = picture()[..., :2]
    result = fit(image, iterations=0, space="data")
    assert result.image.shape == image.shape and result.gaussians.channels == 2
    assert result.psnr_ycbcr == pytest.approx(-10 * np.log10(mse(result.image, image)), abs=0.01)
    with pytest.raises(ValueError, match="fit two channels as space='data'"):
        fit(image)


# --- Light --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def light():
    """A dim room with a lamp of 200."""
    y, x = np.mgrid[:32, :32]
    lamp = 200 * np.exp(-((x - 15) ** 2 + (y - 12) ** 2) / 8)
    wall = 0.05 + 0.4 * x / 32 + 0.02 * (y // 8 % 2)
    return np.stack([wall + lamp, wall + 0.8 * lamp, 0.7 * wall + 0.5 * lamp], 2).astype(np.float32)


MANY = {"gaussians": 200, "iterations": 100}


def test_light_above_1(light):
    """Logarithms leave less error than sums of light; they are the default."""
    reached = []
    for asked, space in (("linear", "radiance"), ("log", "log")):
        result = fit(light, space=asked, encoding="linear", **MANY)
        assert result.gaussians.space == space
        shown = eg.render(result.gaussians).numpy()
        assert shown.max() == pytest.approx(light.max(), rel=0.1)
        reached.append(eg.psnr(to_coded(light), result.image, "pu21"))
        assert result.psnr_ycbcr == pytest.approx(reached[-1], abs=1)
        np.testing.assert_allclose(
            result.image, to_coded(np.maximum(shown, 0)), rtol=1e-4, atol=1e-5
        )
    assert 33 < reached[0] < reached[1]
    for space in ("ycbcr", "rgb"):  # textures clamp sums of codes to 1
        assert fit(light, 9, 0, space=space, encoding="linear").gaussians.space == "log"
    with pytest.raises(eg.ImageError, match="light above 1; give the space 'log'"):
        eg.fit_large(light, gaussians=200, iterations=2, block=32, space="rgb", encoding="linear")


def test_what_the_encoding_says(light):
    """Light is decoded once, or becomes sRGB; an array counts as sRGB."""
    dim = np.minimum(light, 1)
    codes = to_coded(dim)
    for image, encoding, mean in (
        (dim, "linear", dim.mean()),
        (codes, None, dim.mean()),
        (dim, None, to_linear(dim).mean()),
    ):
        result = fit(image, space="linear", encoding=encoding, **MANY)
        assert eg.render(result.gaussians).numpy().mean() == pytest.approx(mean, rel=0.05)
    one, two = (fit(v, 60, 3, encoding=e).image for v, e in ((dim, "linear"), (codes, "srgb")))
    np.testing.assert_allclose(one, two, atol=0.01)  # other roundings
    with pytest.raises(ValueError, match="pass encoding='linear' for light") as error:
        fit(light, space="linear")
    one_line(error)
    with pytest.raises(ValueError, match="encoding 'raw' is unknown"):
        fit(light, encoding="raw")
    with pytest.raises(eg.ImageError, match="scale it first"):
        fit(np.full((2, 2), 1e10), 4, encoding="linear")


# --- Data in any unit ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def values():
    """Heights from 0 to 1, which are no codes of 8 bits."""
    heights = picture()[..., 0].astype(np.float64)
    return (heights - heights.min()) / np.ptp(heights)


def fit_data(values, **options):
    return eg.fit(values, **{"gaussians": SPLATS, "iterations": 60, "space": "data", **options})


def psnr_of_range(found, values):
    """The PSNR with the range as the peak, by NumPy in float64."""
    return 10 * np.log10(np.ptp(values) ** 2 / mse(found.image[..., 0], values))


UNITS = [(1e-6, 1e-2), (300, 1200), (1e6, 0), (1e4, 1e8)]


@pytest.mark.parametrize(("scale", "offset"), UNITS)
def test_psnrs_do_not_depend_on_the_unit(values, scale, offset):
    """Offsets up to 10,000 ranges, of which float32 leaves the range three digits."""
    other = scale * values + offset
    rounded = values
    if abs(offset) > 100 * scale:
        rounded = (np.float64(np.float32(other)) - offset) / scale
    plain, found = fit_data(rounded), fit_data(other)
    assert psnr_of_range(plain, rounded) == pytest.approx(plain.psnr_ycbcr, abs=0.01)
    assert found.psnr_ycbcr == pytest.approx(plain.psnr_ycbcr, abs=0.2)
    if abs(offset) < 100 * scale:  # else the result is rounded as the data are
        assert psnr_of_range(found, other) == pytest.approx(found.psnr_ycbcr, abs=0.05)


def test_data_without_codes_have_no_psnr_rgb(values):
    """Codes run from 0 to 1; other data have none."""
    assert np.isfinite(fit_data(values, iterations=0).psnr_rgb)
    for data in (300 * values, values - 0.1, 0.05 * values):
        found = fit_data(data, iterations=0)
        assert np.isnan(found.psnr_rgb) and np.isfinite(found.psnr_ycbcr)
        assert all(np.isnan(row["psnr_rgb"]) for row in found.trace)


@pytest.mark.parametrize("value", [0.0, 0.3, -7.0, 1e-6, 1e6])
def test_constant_data_are_exact(value):
    """Except for rounding; their range is none, and rounding makes none."""
    found = fit_data(np.full((32, 32), value), iterations=20)
    np.testing.assert_allclose(found.image, value, rtol=1e-6)
    assert found.psnr_ycbcr > 100


def test_normals_from_minus_1_to_1():
    y, x = np.mgrid[:32, :32].astype(np.float32)
    slopes = np.stack([np.sin(x / 9), np.cos(y / 7), np.ones_like(x)], 2)
    normals = slopes / np.linalg.norm(slopes, axis=2, keepdims=True)
    result = fit_data(normals)
    assert np.abs(eg.render(result.gaussians).numpy() - normals).mean() < 0.01

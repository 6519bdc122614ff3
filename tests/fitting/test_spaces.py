"""Fits in every colour space, of data, and of light above 1."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.errors import one_line
from _helpers.families import small_model
from _helpers.packed import few_groups
from _helpers.waves import SPLATS, check_sound, figures, methods, picture
from eigengs_dr.fitting.fit import fit
from eigengs_dr.fitting.problem import pixels_in
from eigengs_dr.image.color import to_coded, to_linear
from eigengs_dr.image.pixels import ImageError
from eigengs_dr.image.space import BLACK, LINEAR, YCBCR
from eigengs_dr.raster.render import render


def test_fit_in_linear_light(backend):
    """The sum is linear light, and its picture sRGB."""
    result = fit(picture(), SPLATS, 60, space="linear", backend=backend)
    check_sound(result, picture())
    assert result.gaussians.space == "linear"
    light = render(result.gaussians).numpy()
    np.testing.assert_allclose(result.image, to_coded(np.maximum(light, 0)), atol=1e-6)
    close = -10 * np.log10(np.mean((light - to_linear(picture())) ** 2))
    coded = -10 * np.log10(np.mean((light - picture()) ** 2))
    assert close > 25 > coded
    assert result.trace[-1]["psnr_rgb"] > 25


def test_linear_light_places_by_what_one_sees(backend):
    """As many splats in the dark as a fit of the coded picture has there."""
    placed = [
        fit(picture(), SPLATS, 0, space=color, backend=backend).gaussians.to_arrays()
        for color in ("linear", "rgb")
    ]
    np.testing.assert_array_equal(placed[0]["mean"], placed[1]["mean"])
    np.testing.assert_array_equal(placed[0]["factor"], placed[1]["factor"])


def test_linear_light_weighs_errors_as_they_show():
    """Squares count by the slope of the sRGB curve, down to the darkest light."""
    light = np.geomspace(BLACK, 1, 50, dtype=np.float32)[None, :, None].repeat(3, axis=2)
    weight = LINEAR.weight(to_linear(to_coded(light)))
    slope = np.gradient(to_coded(light)[0, :, 0], light[0, :, 0])
    ratio = weight[0, :, 0] / slope
    np.testing.assert_allclose(ratio, ratio.mean(), rtol=0.2)
    np.testing.assert_array_equal(LINEAR.weight(0 * light), weight.max())


@methods
@pytest.mark.parametrize("channels", [1, 3])
def test_data_is_taken_as_it_is(backend, method, channels):
    data = picture()[..., :channels]
    if method.needs_model:
        with pytest.raises(ValueError, match="space is 'data', but the start is in 'ycbcr'; use"):
            fit(data, SPLATS, 3, method=method, start=small_model(backend), space="data")
        return
    result = fit(data, SPLATS, 60, method=method, space="data", backend=backend)
    assert result.gaussians.space == "data"
    assert result.gaussians.channels == channels
    assert result.image.shape == data.shape
    np.testing.assert_array_equal(result.image, render(result.gaussians).numpy())
    assert figures(result)[-1] > figures(result)[0] + 1


SMALL = {"gaussians": 300, "iterations": 100}


@pytest.fixture(scope="module")
def light():
    """A dim room with a lamp of 200."""
    y, x = np.mgrid[:40, :48]
    lamp = 200 * np.exp(-((x - 15) ** 2 + (y - 12) ** 2) / 8)
    wall = 0.05 + 0.4 * x / 48 + 0.02 * (y // 8 % 2)
    return np.stack([wall + lamp, wall + 0.8 * lamp, 0.7 * wall + 0.5 * lamp], 2).astype(np.float32)


def test_light_above_1(light):
    """Logarithms leave less error than sums of light."""
    figures = []
    for color, space in (("linear", "radiance"), ("log", "log")):
        result = eg.fit(light, space=color, encoding="linear", **SMALL)
        assert result.gaussians.space == space
        rendered = eg.render(result.gaussians).numpy()
        assert rendered.max() == pytest.approx(light.max(), rel=0.1)
        figures.append(eg.psnr(to_coded(light), result.image, space="pu21"))
        assert result.trace[-1]["psnr_ycbcr"] == pytest.approx(figures[-1], abs=1)
        np.testing.assert_allclose(
            result.image, to_coded(np.maximum(rendered, 0)), rtol=1e-4, atol=1e-5
        )
    assert 33 < figures[0] < figures[1]


def test_linear_input_is_decoded_once(light):
    dim = np.minimum(light, 1)
    for image, said in ((dim, "linear"), (to_coded(dim), None)):
        result = eg.fit(image, space="linear", encoding=said, **SMALL)
        assert result.gaussians.space == "linear"
        mean = eg.render(result.gaussians).numpy().mean()
        assert mean == pytest.approx(dim.mean(), rel=0.02)
    dark = eg.fit(dim, space="linear", **SMALL)  # an array counts as sRGB
    decoded = eg.render(dark.gaussians).numpy().mean()
    assert decoded == pytest.approx(to_linear(dim).mean(), rel=0.05)


@pytest.mark.parametrize("color", ["ycbcr", "rgb"])
def test_light_becomes_srgb_in_other_spaces(light, color):
    dim = np.minimum(light, 1)
    one = eg.fit(dim, space=color, encoding="linear", **SMALL)
    two = eg.fit(to_coded(dim), space=color, **SMALL)
    np.testing.assert_array_equal(one.image, two.image)


def test_light_without_a_word_is_refused_above_1(light):
    with pytest.raises(ValueError, match="pass encoding='linear' for light") as error:
        eg.fit(light, space="linear", **SMALL)
    one_line(error)
    with pytest.raises(ValueError, match="encoding 'raw' is unknown"):
        eg.fit(light, encoding="raw", **SMALL)


def test_data_of_any_range():
    y, x = np.mgrid[:40, :48].astype(np.float32)
    heights = 1200 + 300 * np.sin(x / 9) * np.cos(y / 7)
    result = eg.fit(heights, space="data", **SMALL)
    error = np.sqrt(np.mean((eg.render(result.gaussians).numpy()[..., 0] - heights) ** 2))
    assert error < 3
    np.testing.assert_allclose(result.image[..., 0], heights, atol=30)
    levels = eg.fit(heights, [75, 300], iterations=100, space="data")
    np.testing.assert_allclose(levels.image[..., 0], heights, atol=60)


def test_many_images_of_light(tmp_path, light):
    for name in ("a.pfm", "b.pfm"):
        eg.save_image(tmp_path / name, light)
    rows = eg.fit_many(tmp_path, tmp_path / "out", space="log", **SMALL)
    assert [row.status for row in rows] == ["done", "done"]
    alone = eg.fit(light, space="log", encoding="linear", **SMALL)
    found = eg.Gaussians.load(tmp_path / "out" / "a.npz")
    np.testing.assert_array_equal(found.to_arrays()["color"], alone.gaussians.to_arrays()["color"])
    assert rows[0].psnr_ycbcr == pytest.approx(alone.trace[-1]["psnr_ycbcr"], abs=0.5)
    rows = eg.fit_many([light, light], space="linear", encoding="linear", **SMALL)
    assert [row.result.gaussians.space for row in rows] == ["radiance", "radiance"]


@pytest.mark.parametrize("color", ["radiance", "log"])
def test_by_blocks(light, color):
    result = eg.fit_large(
        light, gaussians=200, iterations=60, block=32, space=color, encoding="linear"
    )
    assert result.psnr_ycbcr > 18
    assert eg.render(result.gaussians).numpy().max() > 100


@pytest.mark.parametrize("color", ["linear", "log"])
@few_groups()
def test_pack(tmp_path, light, color):
    gaussians = eg.fit(light, space=color, encoding="linear", **SMALL).gaussians
    packed = eg.pack(gaussians, tmp_path / "a.egs", light, max_psnr_drop=0.5, encoding="linear")
    assert 0 < packed.psnr_drop <= 0.5
    loaded = eg.Gaussians.load(tmp_path / "a.egs")
    assert loaded.space == gaussians.space
    assert eg.render(loaded).numpy().max() == pytest.approx(light.max(), rel=0.1)


def test_the_image_is_not_copied_in_vain():
    photo = np.random.default_rng(0).random((8, 9, 3)).astype(np.float32)
    assert pixels_in(photo, YCBCR)[0] is photo


@pytest.mark.parametrize("space", ["ycbcr", "rgb"])
def test_light_above_1_is_fitted_without_a_bound_by_default(light, space):
    """Textures clamp sums of codes to 1."""
    assert eg.fit(light, space=space, encoding="linear", **SMALL).gaussians.space == "log"
    with pytest.raises(ImageError, match="light above 1; give the space 'log'"):
        eg.fit_large(light, gaussians=200, iterations=2, block=32, space=space, encoding="linear")


def test_normals_from_minus_1_to_1():
    y, x = np.mgrid[:40, :48].astype(np.float32)
    slopes = np.stack([np.sin(x / 9), np.cos(y / 7), np.ones_like(x)], 2)
    normals = slopes / np.linalg.norm(slopes, axis=2, keepdims=True)
    result = eg.fit(normals, space="data", **SMALL)
    assert np.abs(eg.render(result.gaussians).numpy() - normals).mean() < 0.01

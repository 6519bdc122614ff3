"""Fits in every colour space, and of data."""

import numpy as np
import pytest

from _helpers.families import small_model
from _helpers.waves import SPLATS, check_sound, figures, picture, presets
from eigengs_dr.fitting.fit import fit
from eigengs_dr.fitting.target import BLACK, make_target
from eigengs_dr.image.color import to_coded, to_linear
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
    """Like the root of the slope of the sRGB curve, down to the darkest light."""
    light = np.geomspace(BLACK, 1, 50, dtype=np.float32)[None, :, None].repeat(3, axis=2)
    weight = make_target(to_coded(light), "linear").weight
    slope = np.gradient(to_coded(light)[0, :, 0], light[0, :, 0])
    ratio = weight[0, :, 0] / np.sqrt(slope)
    np.testing.assert_allclose(ratio, ratio.mean(), rtol=0.1)
    np.testing.assert_array_equal(make_target(0 * light, "linear").weight, weight.max())


@presets
@pytest.mark.parametrize("channels", [1, 3])
def test_data_is_taken_as_it_is(backend, preset, channels):
    data = picture()[..., :channels]
    if preset == "eigengs":
        with pytest.raises(ValueError, match="space is 'data', but the start is in 'ycbcr'; use"):
            fit(data, SPLATS, 3, preset=preset, start=small_model(backend), space="data")
        return
    result = fit(data, SPLATS, 60, preset=preset, space="data", backend=backend)
    assert result.gaussians.space == "data"
    assert result.gaussians.channels == channels
    assert result.image.shape == data.shape
    np.testing.assert_array_equal(result.image, render(result.gaussians).numpy())
    assert figures(result)[-1] > figures(result)[0] + 1

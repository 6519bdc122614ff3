"""Fits in every colour space, and of data."""

import numpy as np
import pytest

from _helpers.families import small_model
from _helpers.waves import SIDE, SPLATS, check_sound, figures, picture, presets
from eigengs_dr.fitting import target as targets
from eigengs_dr.fitting.fit import fit
from eigengs_dr.fitting.target import DARKNESS
from eigengs_dr.image.color import to_coded, to_linear
from eigengs_dr.image.io import sample
from eigengs_dr.raster.render import render


@pytest.mark.parametrize("color", ["ycbcr", "rgb"])
def test_colour_spaces(backend, color):
    result = fit(picture(), SPLATS, 60, space=color, backend=backend)
    check_sound(result, picture())
    assert result.gaussians.space == color
    assert result.trace[-1]["psnr_rgb"] > 25


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


def test_a_ramp_of_light_needs_no_more_than_a_few_splats(backend):
    """In sRGB it is bent; the light of the fit rises in equal steps."""
    light = np.broadcast_to(np.linspace(0.2, 0.8, SIDE)[:, None], (SIDE, SIDE, 3))
    result = fit(to_coded(light), SPLATS, 60, space="linear", backend=backend)
    columns = render(result.gaussians).numpy().mean(axis=(0, 2))
    np.testing.assert_allclose(columns, light[0, :, 0], atol=4e-3)


def test_linear_light_places_by_what_one_sees(backend):
    """As many splats in the dark as a fit of the coded picture has there."""
    placed = [
        fit(picture(), SPLATS, 0, space=color, backend=backend).gaussians.to_arrays()
        for color in ("linear", "rgb")
    ]
    np.testing.assert_array_equal(placed[0]["mean"], placed[1]["mean"])
    np.testing.assert_array_equal(placed[0]["factor"], placed[1]["factor"])


def test_linear_light_weighs_errors_in_the_dark(backend, monkeypatch):
    """Without weights, what shows there after coding would be worse: three crops, for chance."""
    photo, light = sample("coffee"), np.linspace(0.05, 1, SIDE, dtype=np.float32)[:, None, None]
    logarithms = []
    for y, x in ((100, 100), (200, 300), (50, 400)):
        dark, shown = photo[y : y + SIDE, x : x + SIDE] * light, []
        for darkness in (DARKNESS, 0.0):
            monkeypatch.setattr(targets, "DARKNESS", darkness)
            image = fit(dark, SPLATS, 60, space="linear", backend=backend).image
            shown.append(np.square(image - dark)[: SIDE // 3].mean())
        logarithms.append(np.log(shown[0] / shown[1]))
    assert np.mean(logarithms) < np.log(0.85)


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
    best = max(result.trace, key=lambda row: row["psnr_ycbcr"])
    error = result.image.astype(np.float64) - data
    assert best["psnr_ycbcr"] == pytest.approx(-10 * np.log10(np.mean(error**2)), abs=1e-6)
    # A value between two codes may be rounded to either: another order of sums has other last bits.
    shown, wanted = (
        255 * np.clip(image, 0, 1).astype(np.float64) for image in (result.image, data)
    )
    errors = [(np.rint(shown + tie) - np.rint(wanted)) ** 2 / 255**2 for tie in (-1e-4, 1e-4)]
    most, least = (-10 * np.log10(f(*errors).mean()) for f in (np.maximum, np.minimum))
    assert most - 1e-6 <= best["psnr_rgb"] <= least + 1e-6
    assert figures(result)[-1] > figures(result)[0] + 1


@pytest.mark.parametrize("init", ["adaptive", "grid", "random"])
def test_data_of_one_channel(backend, init):
    """Of two axes or of three; what three equal channels give, if one is enough."""
    data = picture()[..., 0]
    one = fit(data, SPLATS, 20, init=init, space="data", backend=backend)
    same = fit(data[..., None], SPLATS, 20, init=init, space="data", backend=backend)
    assert one.gaussians.channels == same.gaussians.channels == 1
    np.testing.assert_array_equal(one.image, same.image)
    assert figures(one)[-1] > 20


@pytest.mark.parametrize("color", ["linear", "rgb"])
def test_a_start_of_another_space(backend, color):
    words = f"space is '{color}', but the start is in 'ycbcr'; use space 'ycbcr', or another start"
    for start in (small_model(backend), small_model(backend).gaussians):
        with pytest.raises(ValueError, match=words):
            fit(picture(), start=start, space=color, backend=backend)

"""Mistakes in the properties and parameters of the texture: one line says what to do."""

import numpy as np
import pytest

from _helpers.texture import at, gaussians, mi, texture
from _helpers.variants import in_variants, on_both
from eigengs_dr.plugins import follow, gaussians_of, keep_in_bounds, texture_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

SPECTRAL = on_both("spectral")


class TestMistakes:
    @pytest.mark.parametrize(
        ("properties", "message"),
        [
            ({"filename": "nowhere.npz"}, "nowhere.npz"),
            ({"filename": __file__}, r"test_mistakes\.py"),
            ({"filename": "a.png"}, "a.png: is an image, .* 'eigengs-dr fit', .* plugin bitmap"),
            ({}, "give one of filename"),
            ({"filename": "a.npz", "model": "b.npz"}, "give one of filename"),
        ],
    )
    def test_of_where_from(self, properties, message):
        with pytest.raises(RuntimeError, match=message):
            mi.load_dict({"type": "gaussian_texture", **properties})

    def test_a_photo_as_environment(self):
        with pytest.raises(RuntimeError, match=r"is an image, .* the plugin envmap"):
            mi.load_dict({"type": "gaussian_environment", "filename": "sky.exr"})

    @pytest.mark.parametrize(
        ("properties", "message"),
        [
            ({"wrap_mode": "bounce"}, "wrap_mode 'bounce' is unknown; use one of repeat, mirror"),
            ({"cutoff": 0.0}, "cutoff is 0.0; it must be above 0 and at most 12"),
            ({"prefilter": -1.0}, "prefilter is -1.0; it is the angle of a pixel"),
            ({"prefiltre": 1.0}, "it has no property prefiltre"),
            ({"space": "cmyk"}, "space 'cmyk'"),
            ({"raw": "false"}, "raw is 'false'; it must be a boolean"),
            ({"cutoff": "wide"}, "cutoff is 'wide'; it must be a number"),
            ({"prefilter": False}, "prefilter is False; it must be true, or the angle of a pixel"),
            ({"width": 31.5}, "width is 31.5; it must be an integer"),
        ],
    )
    def test_of_properties(self, properties, message):
        with pytest.raises(RuntimeError) as caught:
            texture(gaussians(), **properties)
        first_line = str(caught.value).splitlines()[0]
        assert message in first_line

    def test_a_set_of_other_channels(self):
        with pytest.raises(RuntimeError, match="has 4 channels; use a set of 1 to 3"):
            texture(gaussians("data", channels=4))

    def test_heights_of_a_set_of_normals(self):
        with pytest.raises(ValueError, match="a bump map needs heights; this set has 2"):
            texture(gaussians("data", channels=2)).eval_1_grad(at(0.5, 0.5))

    def test_an_array_that_is_missing(self):
        properties = texture_of(gaussians())
        del properties["color"]
        with pytest.raises(RuntimeError, match="color is missing"):
            mi.load_dict(properties)

    @in_variants(SPECTRAL)
    @pytest.mark.parametrize("raw", [True, False])
    def test_a_spectrum_from_data(self, variant, raw):
        tex = texture(gaussians("rgb" if raw else "data"), raw=raw)
        with pytest.raises(ValueError, match="not raw data"):
            tex.eval(at(0.5, 0.5))

    @in_variants(["scalar_rgb"])
    def test_scalar_variants(self, variant):
        with pytest.raises(RuntimeError, match="does not support the variant scalar_rgb; use"):
            mi.load_dict({"type": "gaussian_texture", "filename": "x.npz"})

    def test_the_name_of_no_texture(self):
        parameters = mi.traverse(
            mi.load_dict({"type": "diffuse", "reflectance": texture_of(gaussians())})
        )
        for name in ("reflectance.mean", "bsdf.reflectance"):
            for function in (gaussians_of, keep_in_bounds):
                with pytest.raises(ValueError, match=f"no {name}.mean .* mitsuba.traverse"):
                    function(parameters, name, gaussians())

    def test_no_scene_to_follow_in(self):
        sensor = mi.load_dict({"type": "perspective"})
        with pytest.raises(TypeError, match=r"follow: scene is a .*; give a loaded one"):
            follow(sensor, sensor)

    def test_parameters_of_another_shape(self):
        tex = texture(gaussians())
        parameters = mi.traverse(tex)
        parameters["color"] = mi.TensorXf(np.zeros((3, 3), np.float32))
        with pytest.raises(Exception, match=r"color has shape \(3, 3\), expected \(24, 3\)"):
            parameters.update()

"""What Mitsuba asks for after 3.9, by stand-ins with its names."""

import importlib
import re
from enum import Enum
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

from _helpers.process import run_python
from _helpers.texture import gaussians, mi, small_scene
from eigengs_dr.plugins import gaussian_texture, texture_of, versions

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]


class LaterMitsuba:
    """Mitsuba with fields in place of textures, as pull request 1885 has them."""

    FieldValueType = Enum("FieldValueType", "Float Spectrum Color3 Array2 Array3 Features")
    FieldDomain = Enum("FieldDomain", "Surface Interaction SurfaceAndInteraction")

    def __getattr__(self, name):
        if name in ("Texture", "register_texture"):
            raise AttributeError(name)
        return getattr(mi, "Texture" if name == "Field" else name)

    def register_field(self, name, create):
        """Register a texture that asks as C++ asks a field: for what it says to be."""
        kinds = self.FieldValueType

        class Asked(create.made):
            def eval(self, si, active=True):
                if self.out_type() is kinds.Float:
                    return mi.UnpolarizedSpectrum(super().eval_1(si, [], active))
                if self.out_type() is kinds.Spectrum:
                    return super().eval_spec(si, [], active)
                return mi.UnpolarizedSpectrum(super().eval_color3(si, [], active))

            def eval_1(self, si, active=True):
                return super().eval_1(si, None, active)

        mi.register_texture(name, Asked)


@pytest.fixture
def fields(monkeypatch):
    """The texture as a field is "gaussian_field"."""
    monkeypatch.setattr(versions, "mi", LaterMitsuba())
    versions.register("texture", "gaussian_field", gaussian_texture.gaussian_texture())


VARIANTS = ["llvm_ad_rgb", "llvm_ad_spectral"]


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
class TestFields:
    def coat(self, kind):
        """A material whose maps are asked for a colour, a number and a normal."""

        def of(space, channels):
            return {**texture_of(gaussians(space, channels)), "type": kind}

        coat = {"type": "principled", "base_color": of("linear", 3), "roughness": of("data", 1)}
        return {"type": "normalmap", "normalmap": of("normal", 3) | {"raw": True}, "bsdf": coat}

    def test_pictures_and_gradients_are_those_of_textures(self, fields, variant):
        pictures, found = [], []
        for kind in ("gaussian_texture", "gaussian_field"):
            scene = small_scene(self.coat(kind), "prb")
            parameters = mi.traverse(scene)
            key = next(k for k, _ in parameters if k.endswith("base_color.color"))
            dr.enable_grad(parameters[key])
            parameters.update()
            image = mi.render(scene, parameters, spp=4)
            dr.backward(dr.sum(dr.square(image), axis=None))
            pictures.append(np.array(image))
            found.append(np.array(dr.grad(parameters[key])))
        np.testing.assert_array_equal(*pictures)
        np.testing.assert_allclose(*found, rtol=1e-4, atol=1e-5)
        assert np.abs(found[0]).max() > 1e-3

    def test_they_say_what_they_hold(self, fields, variant):
        kinds = LaterMitsuba.FieldValueType
        light = kinds.Spectrum if "spectral" in variant else kinds.Color3
        for space, channels, kind in (
            ("linear", 3, light),
            ("normal", 3, kinds.Color3),
            ("data", 1, kinds.Float),
        ):
            set_of = texture_of(gaussians(space, channels))
            field = mi.load_dict({**set_of, "type": "gaussian_field"})
            assert field.out_type() is kind
            assert field.domain() is LaterMitsuba.FieldDomain.Surface
            assert field.supports_jit() and field.supports_surface_queries()

    def test_the_class_and_the_kind_of_object(self, fields, variant):
        assert versions.texture_class() is mi.Texture  # the stand-in for Field


FOUND = """
import importlib, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
module = importlib.import_module("{module}")
for variant in ("llvm_ad_rgb", "llvm_ad_spectral"):
    mi.set_variant(variant)
    importlib.reload(module)
    try:
        mi.load_dict({{"type": "gaussian_texture"}})
    except RuntimeError as error:
        print(error)
"""


def test_the_entry_point_names_a_module_that_registers():
    """3.10 imports the module, and imports it anew after a change of the variant."""
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text()
    module = re.search(r'entry-points\.mitsuba\]\n(?:#.*\n)*\w+ = "(.*)"', text)[1]
    assert importlib.util.find_spec(module)
    found = run_python(FOUND.format(module=module))
    assert found.stdout.count("give one of filename") == 2, found.stderr

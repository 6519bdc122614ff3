"""The page of the plug-in in the manual, which is made from the class."""

import runpy
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import small_model
from _helpers.lit_spheres import directions, photos
from _helpers.materials import material
from _helpers.texture import backend, gaussians, mi, texel_centres
from eigengs_dr.plugins import texture_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]


@pytest.fixture(scope="module")
def described():
    """Flags by the names of parameters."""
    made = runpy.run_path(str(Path(__file__).parents[2] / "tools" / "manual" / "pages.py"))
    lines = made["plugin_parameters"]("gaussian_texture").splitlines()
    rows = [line.strip("| ").split(" | ") for line in lines[2:]]
    assert all(row[1] and row[2] for row in rows)
    return {name.strip("` "): row[4:] for row in rows for name in row[0].split(",")}


@pytest.fixture
def sources(tmp_path):
    """Textures with all parameters that go together."""
    material(backend=backend()).save(tmp_path / "maps.npz")
    small_model(backend()).save(tmp_path / "model.npz")
    common = {"wrap_mode": "mirror", "raw": True, "prefilter": 0.0, "cutoff": 3.0}
    common["memory"] = "small"
    common["to_uv"] = mi.ScalarTransform4f()
    file = {"filename": str(tmp_path / "maps.npz"), "map": "albedo", "first": 3}
    coefficients = mi.traverse(
        mi.load_dict({"type": "gaussian_texture", "model": str(tmp_path / "model.npz")})
    )["coefficients"]
    model = {"model": str(tmp_path / "model.npz"), "coefficients": coefficients}
    known = directions(10)
    lit = eg.Relightable.fit(
        photos(known), known, gaussians=40, planes=3, iterations=2, backend=backend()
    )
    lit.save(tmp_path / "lights.npz")
    lights = {"model": str(tmp_path / "lights.npz"), "light": [0.3, 0.2, 0.9]}
    kind = {"type": "gaussian_texture"}
    sources = [kind | source | common for source in (file, model, lights)]
    return [texture_of(gaussians()) | common, *sources]


def test_it_has_what_the_class_takes_and_nothing_else(described, sources):
    """A property that no texture asks for is an error of Mitsuba."""
    taken = set()
    for source in sources:
        mi.load_dict(source)
        taken |= set(source) - {"type"}
    assert set(described) == taken


FIXED = ("to_uv", "prefilter")
"""Parameters without derivatives."""


def test_flags_are_those_of_derivatives(described, sources):
    seen = {}
    for source in sources:
        texture = mi.load_dict(source)
        parameters = mi.traverse(texture)
        differentiable = [key for key, _ in parameters if key not in FIXED]
        for key in differentiable:
            dr.enable_grad(parameters[key])
        parameters.update()
        dr.backward(dr.sum(mi.Color3f(texture.eval_3(texel_centres())), axis=None))
        seen |= {key: ["E"] for key in FIXED}
        for key in differentiable:
            assert np.abs(np.array(dr.grad(parameters[key]))).max() > 0, key
            seen[key] = ["D, E"]
    assert {name: flags for name, flags in described.items() if flags} == seen

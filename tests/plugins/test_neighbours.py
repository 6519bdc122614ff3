"""Scenes of other packages, polarized light and projective integrators: the texture is in them."""

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.poster import camera
from _helpers.texture import gaussians, mi, small_scene
from _helpers.variants import in_variants
from eigengs_dr.plugins import texture_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]


def bitmap_of(g, times=16):
    """A bitmap of many texels that shows a set of linear light."""
    shown = np.float32(eg.render(g, g.width * times, g.height * times).numpy())
    if mi.is_spectral:  # there, raw values are no colours
        return {"type": "bitmap", "bitmap": mi.Bitmap(shown)}
    return {"type": "bitmap", "data": mi.TensorXf(shown), "raw": True}


def apart(seen, expected):
    """Root mean square difference, of the mean."""
    seen, expected = np.array(seen), np.array(expected)
    assert np.isfinite(seen).all() and expected.mean() > 0.01
    return np.sqrt(np.mean((seen - expected) ** 2)) / expected.mean()


def both(make):
    """What a function makes of the texture, and of the bitmap."""
    g = gaussians("linear")
    return [make(reflectance) for reflectance in (texture_of(g), bitmap_of(g))]


def test_a_transient_path():
    """Of mitransient: a picture for each time of flight, and their sum."""
    pytest.importorskip("mitransient", reason="mitransient is not installed")

    def render(reflectance):
        film = {"type": "transient_hdr_film", "width": 16, "height": 16}
        film |= {"rfilter": {"type": "box"}}
        film |= {"temporal_bins": 8, "start_opl": 3.0, "bin_width_opl": 2.0}
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "transient_path", "max_depth": 3},
                "sensor": {**camera([0, 0, 3.0]), "film": film},
                "wall": {
                    "type": "rectangle",
                    "bsdf": {"type": "diffuse", "reflectance": reflectance},
                },
                "lamp": {"type": "point", "position": [0, 1, 3], "intensity": 10.0},
            }
        )
        return [np.array(part) for part in mi.render(scene, spp=32, seed=1)]

    (steady, transient), (steady_of_bitmap, transient_of_bitmap) = both(render)
    assert apart(steady, steady_of_bitmap) < 0.005
    assert transient.shape[2] == 8 and apart(transient, transient_of_bitmap) < 0.02


def test_a_scene_of_typed_parts():
    """Of mitsuba-scene-description: the dictionary of the texture stands where a plugin would."""
    msd = pytest.importorskip("mitsuba_scene_description", reason="it is not installed")

    def render(reflectance):
        material = msd.SmoothDiffuseMaterial(reflectance=reflectance)
        scene = msd.Scene(
            integrator=msd.PathTracer(max_depth=2),
            sensors=msd.PerspectivePinholeCamera(
                fov=40, to_world=msd.Transform().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
            ),
            shapes={"wall": msd.Rectangle(bsdf=material)},
            emitters={"sky": msd.ConstantEnvironmentEmitter()},
        )
        return mi.render(mi.load_dict(scene.to_dict()), spp=4, seed=1)

    assert apart(*both(render)) < 1e-3


POLARIZED = ["llvm_ad_mono_polarized", "llvm_ad_spectral_polarized"]


@in_variants(POLARIZED)
@pytest.mark.parametrize("kind", ["diffuse", "plastic"])
def test_polarized_light(variant, kind):
    """All parameters of Stokes."""

    def render(reflectance):
        name = "reflectance" if kind == "diffuse" else "diffuse_reflectance"
        bsdf = {"type": "roughplastic", name: reflectance}
        if kind == "diffuse":
            bsdf = {"type": "diffuse", name: reflectance}
        scene = small_scene(bsdf)
        stokes = mi.load_dict({"type": "stokes", "inner": {"type": "path", "max_depth": 3}})
        return mi.render(scene, integrator=stokes, spp=16, seed=1)

    # Spectra of a colour differ in both models, so light off white counts.
    assert apart(*both(render)) < (0.05 if mi.is_spectral else 1e-3)


@pytest.mark.parametrize("kind", ["direct_projective", "prb_projective"])
def test_projective_integrators(kind):
    """Their pictures, and the derivatives that the plain ones have too: those of colours."""
    g = gaussians("linear")
    seen, gradients = [], []
    for name in (kind, kind.removesuffix("_projective")):
        scene = small_scene({"type": "diffuse", "reflectance": texture_of(g)}, "direct", spp=256)
        parameters = mi.traverse(scene)
        key = "wall.bsdf.reflectance.color"
        dr.enable_grad(parameters[key])
        parameters.update()
        integrator = mi.load_dict({"type": name})
        image = mi.render(scene, parameters, integrator=integrator, seed=1)
        dr.backward(dr.mean(dr.square(image), axis=None))
        seen.append(np.array(image))
        gradients.append(np.array(dr.grad(parameters[key])))
    assert np.abs(gradients[1]).max() > 1e-4
    assert apart(*seen) < 0.1  # by noise
    difference = np.linalg.norm(gradients[0] - gradients[1]) / np.linalg.norm(gradients[1])
    assert difference < 0.1

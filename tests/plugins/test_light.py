"""A texture from a model of lights: its light is a parameter, which an optimiser finds."""

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.lit_spheres import directions, photos
from _helpers.texture import backend, mi, picture, small_scene, texel_centres
from eigengs_dr.image.color import to_linear

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

LIGHT = [0.3, -0.4, 0.8]
NAME = "wall.bsdf.reflectance.light"
SIDE, SPP, SEED, SIZE = 24, 16, 3, (24, 24)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """The file of a model of a bump on a plane, from photos under 30 lights."""
    lights, path = directions(30), tmp_path_factory.mktemp("model") / "m.npz"
    options = {"gaussians": 80, "planes": 4, "iterations": 20, "backend": "llvm"}
    eg.Relightable.fit(photos(lights), lights, **options, progress=False).save(path)
    return str(path)


def scene_of(path, light=LIGHT, integrator="direct"):
    texture = {"type": "gaussian_texture", "model": path, "light": light}
    return small_scene({"type": "diffuse", "reflectance": texture}, integrator, SIDE, SPP)


def test_a_texture_shows_the_model_under_its_light(saved):
    texture = mi.load_dict({"type": "gaussian_texture", "model": saved, "light": LIGHT})
    parameters = mi.traverse(texture)
    assert [key for key, _ in parameters] == ["light", "to_uv", "prefilter"]
    model = eg.Relightable.load(saved, backend())
    for light in (LIGHT, [-3.0, 2.0, 9.0]):
        parameters["light"] = mi.Vector3f(*light)
        parameters.update()
        found = picture(texture.eval_3(texel_centres(SIZE)), SIZE)
        expected = eg.picture_of(model.relight(light)).clip(0, 1)
        np.testing.assert_allclose(found, to_linear(expected), atol=1e-3)


def test_packed_models_are_read(saved, tmp_path):
    eg.pack(eg.Relightable.load(saved, backend()), tmp_path / "m.egs", max_psnr_drop=0.1)
    packed = mi.load_dict({"type": "gaussian_texture", "model": str(tmp_path / "m.egs")})
    whole = mi.load_dict({"type": "gaussian_texture", "model": saved})
    found, expected = (picture(t.eval_3(texel_centres(SIZE)), SIZE) for t in (packed, whole))
    np.testing.assert_allclose(found, expected, atol=0.05)


@pytest.mark.parametrize("integrator", ["direct", "prb"])
def test_the_derivative_is_that_of_finite_differences(saved, integrator):
    scene = scene_of(saved, integrator=integrator)
    parameters = mi.traverse(scene)

    def rendered(light):
        parameters[NAME] = light
        parameters.update()
        return dr.sum(dr.square(mi.render(scene, parameters, seed=SEED, spp=SPP)), axis=None)

    light = mi.Vector3f(*LIGHT)
    dr.enable_grad(light)
    dr.backward(rendered(light))
    step, found = 2e-2, np.array(dr.grad(light)).ravel()
    ends = [
        [
            float(rendered(mi.Vector3f(*(np.array(LIGHT) + s * axis).tolist())).array[0])
            for s in (step, -step)
        ]
        for axis in np.eye(3)
    ]
    expected = np.array([up - down for up, down in ends]) / (2 * step)
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.01 * abs(expected).max())


def test_an_optimiser_finds_the_light_of_a_photo(saved):
    scene = scene_of(saved)
    parameters = mi.traverse(scene)
    photo = mi.TensorXf(mi.render(scene, seed=SEED, spp=64))
    optimiser = mi.ad.Adam(lr=0.05)
    optimiser["light"] = mi.Vector3f(0, 0, 1)
    for step in range(60):
        parameters[NAME] = optimiser["light"]
        parameters.update()
        shown = mi.render(scene, parameters, seed=step, spp=SPP)
        dr.backward(dr.mean(dr.square(shown - photo), axis=None))
        optimiser.step()
    found, true = np.array(optimiser["light"]).ravel(), np.array(LIGHT)
    cosine = found @ true / np.linalg.norm(found) / np.linalg.norm(true)
    assert np.degrees(np.arccos(min(cosine, 1))) < 2


def test_a_light_that_an_optimiser_spoilt_is_that_of_the_camera(saved):
    texture = mi.load_dict({"type": "gaussian_texture", "model": saved, "memory": "exact"})
    expected = picture(texture.eval_3(texel_centres(SIZE)), SIZE)
    parameters = mi.traverse(texture)
    for light in ([np.nan, 0, 1], [0, 0, 0]):
        parameters["light"] = mi.Vector3f(*light)
        parameters.update()
        np.testing.assert_array_equal(picture(texture.eval_3(texel_centres(SIZE)), SIZE), expected)


@pytest.mark.parametrize(
    ("light", "says"), [([0, 0, -1.0], "below the horizon"), ([0, 0, 0.0], "no direction")]
)
def test_lights_that_are_refused(saved, light, says):
    with pytest.raises(RuntimeError, match=says):
        mi.load_dict({"type": "gaussian_texture", "model": saved, "light": light})

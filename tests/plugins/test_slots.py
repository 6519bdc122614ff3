"""The texture in every slot of scenes, as a light, and as the sky."""

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.errors import refused
from _helpers.sets import SIZE
from _helpers.texture import backend, gaussians, mi, small_scene
from _helpers.variants import BOTH_RGB, in_all, in_variants
from eigengs_dr.image.color import to_coded, to_log
from eigengs_dr.plugins import bake_environment, texture_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

others = [
    pytest.param(name, marks=pytest.mark.slow) for name in ("llvm_ad_mono", "llvm_ad_spectral")
]

NESTED = ["principled", "roughplastic", "mask", "blend", "glass", "normals", "two", "bump"]
"""Places of a colour, a number, an average, a cut-out, a share, a roughness, vectors and slopes."""

SLOTS = [*NESTED, "light"]
"""And a sampled light."""


def slots(show):
    """BSDFs with a texture in each kind of place that asks for something else, by name.

    `show` makes the texture of a set.
    """
    colour, number = show(gaussians("linear")), show(gaussians("data", channels=1))
    normal, two = (show(gaussians("data", channels=channels)) for channels in (3, 2))
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    both = {"first": grey, "second": {"type": "roughconductor"}}
    return {
        "principled": {"type": "principled", "base_color": colour, "roughness": number},
        "roughplastic": {"type": "roughplastic", "diffuse_reflectance": colour},
        "mask": {"type": "mask", "opacity": number, "inner": grey},
        "blend": {"type": "blendbsdf", "weight": number, **both},
        "glass": {"type": "roughdielectric", "alpha": number},
        "normals": {"type": "normalmap", "normalmap": normal, "inner": grey},
        "two": {"type": "normalmap", "normalmap": two, "inner": grey},
        "bump": {"type": "bumpmap", "bump": number, "scale": 3.0, "inner": grey},
    }


def fine_bitmap(g, times=16):
    """A bitmap of many texels that shows a set; z follows from x and y of normals."""
    shown = eg.render(g, g.width * times, g.height * times).numpy()
    if shown.shape[2] == 2:
        x, y = 2 * shown[..., 0] - 1, 2 * shown[..., 1] - 1
        z = 0.5 + 0.5 * np.sqrt(np.maximum(1 - x * x - y * y, 0))
        shown = np.concatenate([shown, z[..., None]], axis=2)
    return {"type": "bitmap", "data": mi.TensorXf(np.float32(shown)), "raw": True}


def scene_with(slot, show=texture_of):
    """A scene with a texture in one kind of place."""
    if slot != "light":
        return small_scene(slots(show)[slot], "direct")
    radiance = texture_of(gaussians("linear"))
    if mi.is_spectral:
        radiance = {"type": "d65", "of": radiance}  # else it glows at equal energy
    return small_scene(None, "path", emitter={"type": "area", "radiance": radiance})


class TestSlots:
    @in_variants([*BOTH_RGB, *others])
    @pytest.mark.parametrize("name", SLOTS)
    def test_renders_and_differentiates(self, variant, name):
        """In every slot the picture is finite, changes with the texture, and has a gradient."""
        scene = scene_with(name)
        parameters = mi.traverse(scene)
        keys = [k for k, _ in parameters if k.endswith((".color", ".mean"))]
        assert keys
        for key in keys:
            dr.enable_grad(parameters[key])
        parameters.update()
        image = mi.render(scene, params=parameters, spp=4)
        assert np.isfinite(np.array(image)).all()
        dr.backward(dr.mean(dr.square(image)))
        for key in keys:
            gradient = np.array(dr.grad(parameters[key]))
            assert np.isfinite(gradient).all()
            assert np.abs(gradient).max() > 0, key

    @pytest.mark.parametrize("name", NESTED)
    def test_shows_what_a_bitmap_of_the_same_picture_shows(self, variant, name):
        """Slopes of a bitmap are those of its texels, and random normals point behind a surface."""
        seen, expected = (
            np.array(mi.render(scene_with(name, show), spp=64, seed=1))
            for show in (texture_of, fine_bitmap)
        )
        apart = np.sqrt(np.mean((seen - expected) ** 2)) / expected.mean()
        assert apart < {"bump": 0.02, "normals": 0.02}.get(name, 5e-4)

    @in_all
    def test_particles_leave_it_as_paths_find_it(self, variant):
        """Light traced from the emitter, which samples positions and wavelengths of the texture."""
        emitter = {"type": "area", "radiance": texture_of(gaussians("linear", quiet=False))}
        scene = small_scene(None, emitter=emitter)
        means = [
            np.array(mi.render(scene, integrator=mi.load_dict({"type": t, "max_depth": 3}), spp=64))
            for t in ("path", "ptracer")
        ]
        np.testing.assert_allclose(*(m.mean(axis=(0, 1)) for m in means), rtol=0.05)

    @pytest.mark.parametrize(("space", "most"), [("linear", 1), ("radiance", None), ("log", None)])
    def test_a_lamp_lights_as_a_bitmap_of_the_same_picture_does(self, space, most):
        """Also above 1."""
        g = gaussians(space, quiet=False)
        data = mi.TensorXf(np.clip(eg.render(g, SIZE[0] * 8).numpy(), 0, most))
        means = []
        for radiance in (
            texture_of(g),
            {"type": "bitmap", "data": data, "raw": True, "wrap_mode": "clamp"},
        ):
            scene = small_scene(None, emitter={"type": "area", "radiance": radiance})
            means.append(np.array(mi.render(scene, spp=256, seed=1)).mean(axis=(0, 1)))
        np.testing.assert_allclose(means[0], means[1], rtol=0.02)


BRIGHT = np.array([7.0, 5.0, 3.0])


def even(space, value, size=(32, 16)):
    """A set that is the same everywhere."""
    return eg.Gaussians.from_arrays(
        [[4, 4]], [[0.5, 0, 0.5]], [[0, 0, 0]], value, size=size, space=space, backend=backend()
    )


@pytest.mark.parametrize(
    ("space", "value"),
    [("radiance", BRIGHT), ("log", to_log(BRIGHT)), ("rgb", to_coded(BRIGHT / 10))],
)
def test_sky_of_a_set(space, value):
    light = BRIGHT / 10 if space == "rgb" else BRIGHT
    mi.load_dict({"type": "scene"})  # without OptiX this test ends here, before the bitmap
    emitter = bake_environment(even(space, value), width=16, scale=2.0)
    scene = mi.load_dict({"type": "scene", "sky": emitter, "integrator": {"type": "path"}})
    ray = mi.Ray3f(mi.Point3f(0, 0, 0), mi.Vector3f(0.3, 0.4, 0.5))
    seen = scene.environment().eval(scene.ray_intersect(ray))
    np.testing.assert_allclose(np.array(seen).ravel(), 2 * light, rtol=1e-3)


def test_data_is_no_sky():
    with refused(ValueError, "bake_environment: the set has 3 channels"):
        bake_environment(even("data", BRIGHT))

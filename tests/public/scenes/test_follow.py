"""Textures that follow a sensor: their prefilter is the pixel of the sensor, whatever changes."""

import drjit as dr
import numpy as np
import pytest

from _helpers.errors import refused
from _helpers.texture import at, gaussians, in_front, mi, small_scene, texture
from eigengs_dr.plugins import environment_of, follow, pixel_angle, texture_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

NAME = "wall.bsdf.reflectance.prefilter"


def scene_with(prefilter, **others):
    """A wall with a texture."""
    reflectance = {**texture_of(gaussians("linear")), "prefilter": prefilter}
    return small_scene({"type": "diffuse", "reflectance": reflectance, **others}, "direct")


def picture(scene):
    return np.array(mi.render(scene, spp=2, seed=1))


def changed(scene, **values):
    """Change parameters of the camera."""
    parameters = mi.traverse(scene)
    for key, value in values.items():
        parameters[f"sensor.{key.replace('__', '.')}"] = value
    parameters.update()
    return scene


@pytest.mark.parametrize("change", [{}, {"x_fov": 70.0, "film__size": [6, 6]}])
def test_a_change_of_the_camera_changes_the_prefilter(change):
    scene = scene_with(0.5)  # far too wide
    follow(scene)
    changed(scene, **change)
    angle = pixel_angle(scene.sensors()[0])
    assert np.array(mi.traverse(scene)[NAME]) == pytest.approx(angle)
    np.testing.assert_array_equal(picture(scene), picture(changed(scene_with(angle), **change)))


def test_a_frozen_rendering_follows_too():
    scene = scene_with(True)
    follow(scene)
    frozen = dr.freeze(lambda scene: mi.render(scene, spp=2, seed=1))
    for fov in (40.0, 40.0, 15.0, 70.0):
        changed(scene, x_fov=fov)
        np.testing.assert_array_equal(np.array(frozen(scene)), picture(scene))
    frozen.clear()


def test_a_number_ends_it_and_switches_footprints():
    """The parameter turns the prefilter on, changes it, and turns it off."""
    scene = scene_with(0.0)
    parameters = mi.traverse(scene)
    for angle in (0.05, 0.1, 0.0):
        follow(scene)
        parameters[NAME] = angle
        parameters.update()
        np.testing.assert_array_equal(picture(scene), picture(scene_with(angle)))
    with pytest.raises(ValueError, match=r"prefilter is 1\.5; it is the angle of a pixel"):
        parameters.update({NAME: 1.5})


def test_true_waits_for_a_sensor():
    tex = texture(gaussians("linear"), prefilter=True)
    with refused(ValueError, "prefilter = true needs a sensor"):
        tex.eval(in_front(at(0.5, 0.5)))


@pytest.mark.parametrize("kind", ["texture", "environment"])
def test_a_scene_that_waits_for_a_sensor_leaves_others_alone(kind):
    """Dr.Jit records the lookups of all scenes that are alive."""
    plain = scene_with(0.0)
    alone = picture(plain)
    if kind == "texture":
        waits = scene_with(True)
    else:
        light = environment_of(gaussians("linear"), prefilter=True)
        waits = mi.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "light": light})
    with pytest.warns(UserWarning, match=f"{kind}.*: prefilter = true needs a sensor.*at points"):
        seen = picture(plain)
    np.testing.assert_array_equal(seen, alone)
    follow(waits)
    np.testing.assert_array_equal(picture(plain), alone)


@pytest.mark.parametrize(
    ("sensor", "error", "message"),
    [("x", TypeError, "'x' is no sensor"), (3, ValueError, "there is no sensor 3; the scene has")],
)
def test_what_is_no_sensor_is_refused(sensor, error, message):
    """Though nothing of the scene would follow it."""
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective"}})
    with refused(error, message):
        follow(scene, sensor)
    with pytest.raises(TypeError, match=r"follow: scene is a .*; give a loaded one"):
        follow(scene.sensors()[0], sensor)


def test_all_textures_of_the_scene():
    """Also those inside of others, lamps, and the sky."""
    inner = {"type": "checkerboard", "color0": texture_of(gaussians("linear"))}
    lamp = {"type": "area", "radiance": {"type": "d65", "of": texture_of(gaussians("linear"))}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective"},
            "sky": environment_of(gaussians("linear")),
            "wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": inner}},
            "lamp": {"type": "rectangle", "emitter": lamp},
        }
    )
    follow(scene, scene.sensors()[0])
    found = [np.array(value) for key, value in mi.traverse(scene) if key.endswith("prefilter")]
    assert len(found) == 3 and np.allclose(found, pixel_angle(scene.sensors()[0]))


def test_a_sensor_without_a_field_of_view_is_refused():
    scene = scene_with(0.1)
    with refused(ValueError, "has no x_fov"):
        follow(scene, mi.load_dict({"type": "orthographic"}))
    np.testing.assert_array_equal(picture(scene), picture(scene_with(0.1)))

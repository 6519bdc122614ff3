"""Light above 1 in scenes: environment maps, and area lights with a texture."""

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")
import eigengs_dr as eg  # noqa: E402
from _helpers.errors import refused  # noqa: E402
from _helpers.texture import small_scene  # noqa: E402
from eigengs_dr.image.color import to_coded, to_log  # noqa: E402
from eigengs_dr.plugins import bake_environment, texture_of  # noqa: E402

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

BRIGHT = np.array([7.0, 5.0, 3.0])


def even(space, value, size=(32, 16)):
    """A set that is the same everywhere."""
    backend = mi.variant().split("_")[0]
    return eg.Gaussians.from_arrays(
        [[4, 4]], [[0.5, 0, 0.5]], [[0, 0, 0]], value, size=size, space=space, backend=backend
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


@pytest.mark.parametrize("space", ["radiance", "log"])
def test_an_area_light_above_1(space):
    g = even(space, BRIGHT if space == "radiance" else to_log(BRIGHT))
    lamps = [texture_of(g), {"type": "rgb", "value": BRIGHT.tolist()}]
    pictures = [
        np.array(mi.render(small_scene(None, emitter={"type": "area", "radiance": lamp}), seed=1))
        for lamp in lamps
    ]
    np.testing.assert_allclose(pictures[0].mean(), pictures[1].mean(), rtol=0.02)
    assert pictures[0].max() > 6

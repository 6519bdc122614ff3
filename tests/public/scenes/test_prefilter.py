"""The prefilter: footprints of the camera, against brute force and against many samples a pixel."""

import numpy as np
import pytest

from _helpers.arrays import upload_rows
from _helpers.footprints import brute_force
from _helpers.poster import camera
from _helpers.sets import SIZE, random_scene
from _helpers.texture import at, backend, gaussians, in_front, mi, texture
from eigengs_dr.plugins import pixel_angle, texture_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

PIXEL = 0.4
"""Standard deviation of the footprint of a pixel, in pixels."""

LARGEST = 0.4
"""Largest standard deviation of a footprint, in widths and heights of the texture."""


def plane(tex, tiles=60):
    """A plane that glows with the texture, receding to the horizon: no lights, no noise."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1},
            "sensor": camera([0, -30, 3], 48, fov=50, target=[0, 0, -8], up=[0, 0, 1], spp=1),
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.5}},
            "plane": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale([200, 200, 1]),
                "emitter": {
                    "type": "area",
                    "radiance": {**tex, "to_uv": mi.ScalarTransform4f().scale(tiles)},
                },
            },
        }
    )


def clamped(scene, **properties):
    """The clamped texture of a set, without decoding."""
    return texture(scene.on(backend()), wrap_mode="clamp", raw=True, cutoff=5.0, **properties)


class TestCone:
    @pytest.mark.parametrize(
        ("tilt", "linear"), [(0.0, np.eye(2)), (1.2, np.array([[0.6, 0.9], [-0.3, 1.1]]))]
    )
    def test_is_as_wide_as_a_pixel_and_as_long_as_the_tilt_makes_it(self, tilt, linear):
        """Also for a `to_uv` that is no scale."""
        scene, angle = random_scene(), 0.05
        to_uv = mi.ScalarTransform3f(np.pad(linear, (0, 1)) + np.diag([0, 0, 1.0]))
        place = np.array([[0.4, 0.6], [0.5, 0.3]])
        si = in_front(at(*upload_rows(mi.Float, np.linalg.solve(linear, place.T))), 2.0)
        si.wi = mi.Vector3f(0, float(np.sin(tilt)), float(np.cos(tilt)))
        found = np.array(clamped(scene, to_uv=to_uv, prefilter=angle).eval(si)).T
        axes = linear @ np.diag([1, 1 / np.cos(tilt)]) * PIXEL * angle * 2 * np.array(SIZE)[:, None]
        exact = brute_force(scene, "clamp", place * SIZE, axes @ axes.T)
        np.testing.assert_allclose(found, exact, atol=0.02)

    @pytest.mark.parametrize("change", ["no uv", "a line", "no distance", "infinite", "nan"])
    def test_without_a_jacobian_there_is_none(self, change):
        si = in_front(at(0.3, 0.6))
        if change == "no uv":
            si.dp_du = si.dp_dv = mi.Vector3f(0)
        elif change == "a line":
            si.dp_dv = mi.Vector3f(si.dp_du)
        elif change == "nan":
            si.dp_du = mi.Vector3f(np.nan)
        else:
            si.t = 0.0 if change == "no distance" else np.inf
        filtered, point = (
            np.array(texture(gaussians(), prefilter=angle).eval(si)) for angle in (0.001, 0.0)
        )
        np.testing.assert_allclose(filtered, point, atol=1e-5)

    def test_at_grazing_angles_and_from_afar_it_stays_bounded(self):
        """The largest footprint sees the border too, which the mean does not know."""
        scene = random_scene()
        covariance = np.diag((LARGEST * np.array(SIZE)) ** 2)
        exact = brute_force(scene, "clamp", np.array([[0.4, 0.6]]) * SIZE, covariance)
        tex = clamped(scene, prefilter=0.5)
        for distance in (1e3, 1e6):
            found = np.array(tex.eval(in_front(at(0.4, 0.6), distance))).T
            np.testing.assert_allclose(found, exact, atol=0.02)
        grazing = in_front(at(0.4, 0.6))
        grazing.wi = mi.Vector3f(0, 1, 1e-6)
        seen = np.array(clamped(scene, prefilter=0.001).eval(grazing)).ravel()
        axes = np.diag((np.array([PIXEL * 0.001, LARGEST]) * SIZE) ** 2)
        column = brute_force(scene, "clamp", np.array([[0.4, 0.6]]) * SIZE, axes)
        np.testing.assert_allclose(seen, column.ravel(), atol=0.03)

    def test_pixel_angle(self):
        sensor = plane(texture_of(gaussians())).sensors()[0]
        assert pixel_angle(sensor) == pytest.approx(2 * np.tan(np.radians(25)) / 48)


def test_one_filtered_sample_is_closer_to_the_mean_of_many():
    g = gaussians("linear")
    g.color *= 4
    tex = texture_of(g)
    angle = pixel_angle(plane(tex).sensors()[0])
    reference = np.array(mi.render(plane(tex), spp=512, seed=9))
    errors = []
    for prefilter in (angle, 0.0):
        scene = plane({**tex, "prefilter": prefilter})
        images = [np.array(mi.render(scene, spp=1, seed=s)) for s in range(4)]
        errors.append(np.square(images - reference).mean())
    assert errors[0] < 0.35 * errors[1]


@pytest.mark.parametrize(
    ("angle", "u", "v"), [(0.03, None, 0.4), (0.3, -1.2, None), (0.9, None, 0.4)]
)
def test_clamped_it_sees_the_centres_of_outer_pixels_continued(angle, u, v):
    """Along a line across the image and far beyond, against brute force, and without a jump."""
    scene, line = random_scene(), np.linspace(-1, 2, 1201)
    uv = np.stack([line if k is None else np.full_like(line, k) for k in (u, v)], axis=1)
    si = in_front(at(*upload_rows(mi.Float, uv.T)))
    found = np.array(clamped(scene, prefilter=angle).eval(si)).T
    covariance = np.diag((PIXEL * angle * np.array(SIZE)) ** 2)
    exact = brute_force(scene, "clamp", (uv * SIZE)[::40], covariance)
    np.testing.assert_allclose(found[::40], exact, atol=0.02)
    assert np.abs(np.diff(found, axis=0)).max() < 0.02 + 0.02 / angle / 12


def test_a_footprint_that_sees_all_sees_the_mean():
    tex = texture(gaussians("linear"), prefilter=0.5)
    si = in_front(at(0.7, 0.1), 1e4)
    np.testing.assert_allclose(np.array(tex.eval_1(si)), np.array(tex.mean()), atol=2e-3)

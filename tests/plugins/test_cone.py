"""The prefilter in Mitsuba: footprints of the camera, against many samples per pixel."""

import gc

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.footprints import brute_force
from _helpers.poster import camera
from _helpers.sets import SIZE, random_scene
from _helpers.texture import (
    at,
    backend,
    gaussians,
    in_front,
    mi,
    picture,
    texel_centres,
    texture,
)
from eigengs_dr.backend.arrays import upload_rows
from eigengs_dr.plugins import pixel_angle, texture_of
from eigengs_dr.plugins.cone import PIXEL, metric
from eigengs_dr.raster.lookup.footprint import MAX_FOOTPRINT, bound_covariance

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]


IDENTITY = (1.0, 0.0, 0.0, 1.0)


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


def facing(tilt=0.0, t=10.0):
    """A surface whose uv are metres, seen under a tilt about its u axis from a distance."""
    si = in_front(dr.zeros(mi.SurfaceInteraction3f), t)
    si.wi = mi.Vector3f(0, float(np.sin(tilt)), float(np.cos(tilt)))
    return si


class TestCone:
    @pytest.mark.parametrize("tilt", [0.0, 0.5, 1.4])
    @pytest.mark.parametrize("t", [1.0, 10.0])
    @pytest.mark.parametrize("linear", [np.eye(2), np.array([[0.6, 0.9], [-0.3, 1.1]])])
    def test_is_as_wide_as_a_pixel_and_as_long_as_the_tilt_makes_it(self, tilt, t, linear):
        """Against the plain product of matrices, also for a `to_uv` that is no scale."""
        rows, valid = metric(facing(tilt, t), tuple(np.linalg.inv(linear).ravel()), 0.001)
        assert valid == [True]
        axes = linear @ np.diag([1, 1 / np.cos(tilt)]) * PIXEL * 0.001 * t
        expected = np.linalg.inv(axes @ axes.T)[[0, 0, 1], [0, 1, 1]]
        np.testing.assert_allclose(np.ravel(rows), expected, rtol=1e-3, atol=1e-3)

    def test_at_grazing_angles_it_stays_bounded(self):
        rows, valid = metric(facing(np.pi / 2 - 1e-6), IDENTITY, 0.001)
        assert valid == [True]
        covariance, _ = bound_covariance(rows)
        assert np.sqrt(np.array(covariance[2])) == pytest.approx(MAX_FOOTPRINT, rel=1e-3)

    @pytest.mark.parametrize("change", ["no uv", "a line", "no distance", "infinite", "nan"])
    def test_without_a_jacobian_there_is_none(self, change):
        si = facing()
        if change == "no uv":
            si.dp_du = si.dp_dv = mi.Vector3f(0)
        elif change == "a line":
            si.dp_dv = mi.Vector3f(si.dp_du)
        elif change == "nan":
            si.dp_du = mi.Vector3f(np.nan)
        else:
            si.t = 0.0 if change == "no distance" else np.inf
        assert metric(si, IDENTITY, 0.001)[1] == [False]
        si.uv = mi.Point2f(0.3, 0.6)
        filtered, point = (
            np.array(texture(gaussians(), prefilter=angle).eval(si)) for angle in (0.001, 0.0)
        )
        np.testing.assert_allclose(filtered, point, atol=1e-5)

    def test_pixel_angle(self):
        sensor = plane(texture_of(gaussians())).sensors()[0]
        assert pixel_angle(sensor) == pytest.approx(2 * np.tan(np.radians(25)) / 48)

    def test_of_a_sensor_without_a_field_of_view(self):
        with pytest.raises(ValueError, match="has no x_fov"):
            pixel_angle(mi.load_dict({"type": "orthographic"}))


class TestPlane:
    @pytest.mark.parametrize("wrap", ["repeat", "mirror"])
    def test_one_filtered_sample_is_closer_to_the_mean_of_many(self, wrap):
        g = gaussians("linear")
        g.color *= 4
        tex = {**texture_of(g), "wrap_mode": wrap}
        angle = pixel_angle(plane(tex).sensors()[0])
        reference = np.array(mi.render(plane(tex), spp=512, seed=9))
        errors = []
        for prefilter in (angle, 0.0):
            scene = plane({**tex, "prefilter": prefilter})
            images = [np.array(mi.render(scene, spp=1, seed=s)) for s in range(4)]
            errors.append(np.square(images - reference).mean())
        assert errors[0] < 0.35 * errors[1]

    @pytest.mark.parametrize("angle", [0.03, 0.3, 0.9])
    @pytest.mark.parametrize(("u", "v"), [(None, 0.4), (0.3, None), (None, 1.4), (-1.2, None)])
    def test_clamped_it_sees_the_centres_of_outer_pixels_continued(self, angle, u, v):
        """Along a line across the image and far beyond, against brute force, and without a jump."""
        scene, line = random_scene(), np.linspace(-1, 2, 1201)
        uv = np.stack([line if k is None else np.full_like(line, k) for k in (u, v)], axis=1)
        tex = texture(scene.on(backend()), wrap_mode="clamp", raw=True, cutoff=5.0, prefilter=angle)
        si = in_front(at(*upload_rows(mi.Float, uv.T)))
        found = np.array(tex.eval(si)).T
        covariance = np.diag((PIXEL * angle * np.array(SIZE)) ** 2)
        exact = brute_force(scene, "clamp", (uv * SIZE)[::40], covariance)
        np.testing.assert_allclose(found[::40], exact, atol=0.02)
        assert np.abs(np.diff(found, axis=0)).max() < 0.02 + 0.02 / angle / 12

    @pytest.mark.parametrize("times", [2, 4])
    def test_a_footprint_of_several_texels_shows_what_a_smaller_picture_does(self, times):
        """Away from the borders, where a picture has no copies of itself."""
        side, small = 32, 32 // times
        g = random_scene(2, 60, (side, side)).on(backend())
        box = np.sqrt((times**2 - 1) / 12) / side  # of the pixels of a picture that is averaged
        tex = texture(g, raw=True, prefilter=box / PIXEL)
        seen = picture(tex.eval(in_front(texel_centres((small, small)))), (small, small))
        expected = eg.render(g, small).numpy()
        inside = (slice(small // 4, -(small // 4)),) * 2
        np.testing.assert_allclose(seen[inside], expected[inside], atol=0.005)
        plain = eg.render(g, small, filter=False).numpy()
        assert np.abs(seen - plain)[inside].max() > 0.05

    @pytest.mark.parametrize("scale", [1e3, 1e6])
    def test_clamped_from_afar_it_does_not_jump_to_the_mean(self, scale):
        """The largest footprint sees the border too, which the mean does not know."""
        scene = random_scene()
        tex = texture(scene.on(backend()), wrap_mode="clamp", raw=True, cutoff=5.0, prefilter=0.5)
        found = np.array(tex.eval(in_front(at(0.4, 0.6), scale))).T
        covariance = np.diag((MAX_FOOTPRINT * np.array(SIZE)) ** 2)
        exact = brute_force(scene, "clamp", np.array([[0.4, 0.6]]) * SIZE, covariance)
        np.testing.assert_allclose(found, exact, atol=0.02)

    def test_a_footprint_that_sees_all_sees_the_mean(self):
        g = gaussians("linear")
        tex = texture(g, prefilter=0.5)
        si = facing(t=1e4)
        si.uv = mi.Point2f(0.7, 0.1)
        np.testing.assert_allclose(np.array(tex.eval_1(si)), np.array(tex.mean()), atol=2e-3)


def test_the_collector_stays_out_of_lookups():
    """Scenes freed while another one is recorded end the process; see `collector_off`."""
    works = []

    class Watched:
        """A point that notes whether the collector works while it is looked up."""

        def __getattr__(self, name):
            works.append(gc.isenabled())
            return getattr(facing(), name)

    tex = texture(gaussians())
    tex.eval(Watched())
    tex.eval_3(Watched())
    with pytest.raises(ValueError, match="three channels"):
        texture(gaussians("data", channels=1)).eval_3(facing())
    assert works and not any(works) and gc.isenabled()


HUGE = 3.3e38


@pytest.mark.parametrize(
    "factor",
    [
        (1e-20, 0, 1e-20),
        (1e-37, 0, 1),
        (1, 0, 1e-37),
        (HUGE, 0, HUGE),
        (1, HUGE, 1),
        (1e-30, HUGE, 1e-30),
        (HUGE, HUGE, HUGE),
    ],
)
@pytest.mark.parametrize("wrap", ["repeat", "clamp"])
def test_extreme_gaussians_stay_finite(factor, wrap):
    """Very wide, very narrow and very long ones, near, and from afar in the pyramid."""
    factors = [factor, (0.3, 0, 0.3)]
    g = eg.Gaussians.from_arrays(
        [[8, 4], [3, 3]], factors, [[0.5], [0.2]], size=(16, 8), space="data", backend=backend()
    )
    tex = texture(g, prefilter=0.1, wrap_mode=wrap)
    for distance in (0.01, 0.5, 2.0, 10.0):
        points = in_front(at(mi.Float(0.1, 0.45, 0.99), mi.Float(0.3, 0.5, 0.02)), distance)
        assert np.isfinite(np.array(tex.eval_1(points))).all()

"""Light from Gaussians: the picture of an ``envmap``, sampling, changes, mistakes."""

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.arrays import upload_rows
from _helpers.chi_square import assert_density
from _helpers.skies import HEIGHT, WIDTH, directions, lit, mi, seen, sky, uniform
from _helpers.texture import backend
from _helpers.variants import BOTH_RGB_AND_SLOW_SPECTRAL, in_all, in_variants
from eigengs_dr.plugins import bake_environment, environment_of, gaussians_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]


def turn():
    """A rotation about all axes."""
    transform = mi.ScalarTransform4f()
    for axis, angle in ([0, 1, 0], 40), ([1, 0, 0], 100), ([0, 0, 1], -30):
        transform = transform.rotate(axis, angle)
    return transform


def texels(width=WIDTH, height=HEIGHT):
    """Directions of the centres of texels, without the poles, where all columns meet."""
    y, x = np.mgrid[1 : height - 1, :width]
    return directions((x.ravel() + 0.5) / width, y.ravel() / (height - 1))


def one(mean, light, size, background=None):
    """The environment of one white Gaussian, in parts: programs of a single one are others."""
    parts = [mean] * 70, [[0.3, 0, 0.3]] * 70, [[light / 70] * 3] * 70
    return eg.Gaussians.from_arrays(
        *parts, background, size=size, space="radiance", backend=backend()
    )


class TestPicture:
    @pytest.mark.parametrize(("space", "channels"), [("radiance", 3), ("log", 3), ("linear", 1)])
    def test_is_that_of_eg_render(self, space, channels):
        """Negative light is none."""
        g = sky(space, channels)
        g.background *= -5 if space == "radiance" else 1
        found = seen(mi.load_dict(environment_of(g)), texels())
        expected = eg.render(g).numpy()[1:-1].reshape(-1, channels)
        assert (expected.min() < 0) == (space == "radiance")
        top = 1 if space == "linear" else np.inf
        expected = np.broadcast_to(expected.clip(0, top), found.shape)
        np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-4)

    @in_all
    def test_is_that_of_an_envmap(self, variant):
        """At texels; spectra differ, and so do their pictures by a little."""
        g, placed = sky(), {"to_world": turn(), "scale": 1.5}
        pictures = []
        for emitter in (environment_of(g, **placed), bake_environment(g, **placed)):
            pictures.append(np.array(mi.render(lit(emitter, "direct", 32), spp=512, seed=1)))
        difference = pictures[0] - pictures[1]
        assert np.sqrt(np.square(difference).mean()) < 0.025 * pictures[1].mean()
        assert abs(difference.mean()) < 0.005 * pictures[1].mean()

    def test_occluders_are_in_front_of_it_however_large_they_are(self):
        """What hides the sky hides it, although emitters in Python do not know the scene."""
        to_world = mi.ScalarTransform4f().translate([0, 5e4, 0]).rotate([1, 0, 0], 90).scale(1e7)
        roof = {"type": "rectangle", "to_world": to_world}
        scene = mi.load_dict({"type": "scene", "roof": roof, "sky": environment_of(sky())})
        si = dr.zeros(mi.SurfaceInteraction3f, 4096)
        si.n = si.sh_frame.n = mi.Normal3f(0, 1, 0)
        ds, weight = scene.sample_emitter_direction(si, uniform(4096), True)
        up = np.array(ds.d.y) > 0.02
        assert np.array(weight)[:, up].max() == 0
        assert np.array(weight)[:, np.array(ds.d.y) < -0.02].min() > 0


class TestSeamAndPoles:
    def test_a_gaussian_ends_at_the_seam_as_in_its_picture(self):
        half, v = one([0, 16], 1, (64, 32)), np.full(2, 15.5 / 31)
        found = seen(mi.load_dict(environment_of(half)), directions(np.array([0.01, 0.99]), v))
        assert found[0, 0] > 0.9
        assert found[1, 0] == 0
        # With a footprint of 0.4 x 0.5 = 0.2 radians, half of the light at the seam.
        blurred = mi.load_dict(environment_of(half, prefilter=0.5))
        near = seen(blurred, directions(np.array([0.001, 0.999]), v))
        np.testing.assert_allclose(near[0], near[1], rtol=0.05)

    def test_at_the_poles_and_where_there_is_no_direction(self):
        emitter = mi.load_dict(environment_of(sky(), prefilter=0.02))
        d = np.float32([[0, 1, 0], [0, -1, 0], [1e-4, 1, 0], [0, -1, 1e-4]]).T
        assert np.isfinite(seen(emitter, d / np.linalg.norm(d, axis=0))).all()
        ds = dr.zeros(mi.DirectionSample3f, 4)
        ds.d = mi.Vector3f(*upload_rows(mi.Float, d))
        density = np.array(emitter.pdf_direction(dr.zeros(mi.Interaction3f, 4), ds))
        assert np.isfinite(density).all()
        assert density.min() > 0
        assert (seen(emitter, np.float32([[np.nan], [0], [1]])) == 0).all()


class TestFootprint:
    def test_is_the_mean_over_a_gaussian_on_the_sphere(self):
        """Away from the poles, where the plane of the picture bends."""
        g = sky(deviation=(2.0, 3.0))
        sharp, blurred = (mi.load_dict(environment_of(g, prefilter=p)) for p in (0, 0.4))
        rng = np.random.default_rng(3)
        u, v = rng.uniform(0, 1, 8), rng.uniform(0.3, 0.7, 8)
        found = seen(blurred, directions(u, v))
        sigma, count = 0.4 * 0.4, 20_000
        for k in range(8):
            east, south = sigma * rng.normal(size=(2, count))
            around = seen(
                sharp,
                directions(u[k] + east / (2 * np.pi * np.sin(np.pi * v[k])), v[k] + south / np.pi),
            )
            np.testing.assert_allclose(found[k], around.mean(axis=0), rtol=0.03)


SETS = {
    "sharp": {"deviation": (0.2, 0.5)},
    "log": {"space": "log", "deviation": (0.5, 3.0)},
}


class TestSampling:
    @pytest.mark.parametrize("name", SETS)
    def test_samples_have_their_density(self, name):
        """By the chi-square test, by the weights, and the density is 1 over the sphere."""
        from mitsuba.chi2 import SphericalDomain

        emitter = mi.load_dict(environment_of(sky(**SETS[name]), to_world=turn()))

        def sample(numbers):
            it = dr.zeros(mi.Interaction3f, dr.width(numbers))
            return emitter.sample_direction(it, numbers)[0].d

        def density(d):
            ds = dr.zeros(mi.DirectionSample3f, dr.width(d))
            ds.d = d
            return emitter.pdf_direction(dr.zeros(mi.Interaction3f, dr.width(d)), ds)

        assert_density(sample, density, SphericalDomain(), 100_000, 32)
        even = mi.warp.square_to_uniform_sphere(uniform(400_000))
        whole = 4 * np.pi * np.array(density(even), np.float64)
        assert abs(whole.mean() - 1) < 5 * whole.std() / np.sqrt(len(whole))
        it = dr.zeros(mi.Interaction3f, 10_000)
        ds, weight = emitter.sample_direction(it, uniform(10_000))
        same = np.isclose(np.array(density(ds.d)), np.array(ds.pdf), rtol=1e-2)
        assert same.mean() > 0.995
        light = np.array(emitter.eval_direction(it, ds) / ds.pdf)
        np.testing.assert_allclose(light, np.array(weight), rtol=0.02, atol=1e-3)

    def test_one_sample_finds_the_light(self):
        """Of a sun 1,000 times as bright as the sky; evenly spread samples have a noise of 20."""
        sun = one([100, 60], 1000, (512, 256), background=[1] * 3)
        emitter = mi.load_dict(environment_of(sun))
        _, weight = emitter.sample_direction(dr.zeros(mi.Interaction3f, 100_000), uniform(100_000))
        light = np.array(weight, np.float64)[0]
        assert light.std() < 0.3 * light.mean()

    @pytest.mark.parametrize("value", [0, -1])
    def test_black_light_is_sampled_evenly_in_the_picture(self, value):
        g = sky()
        g.color *= 0
        g.background *= value
        emitter = mi.load_dict(environment_of(g))
        ds, weight = emitter.sample_direction(dr.zeros(mi.Interaction3f, 100), uniform(100))
        assert np.isfinite(np.array(ds.pdf)).all()
        assert (np.array(weight) == 0).all()

    @in_variants(BOTH_RGB_AND_SLOW_SPECTRAL)
    def test_rays_from_the_light(self, variant):
        """Light traced from the sky is that traced from the camera, the background too.

        A sensor sees nothing beyond its far clip plane.
        """
        scene = lit(environment_of(sky()), side=12)
        scene.environment().set_scene(scene)
        for hidden in (True, False):
            depth = {"max_depth": 3, "hide_emitters": hidden}
            means = []
            for kind, spp in (("ptracer", 1024), ("path", 256)):
                integrator = mi.load_dict({"type": kind, **depth})
                image = np.array(mi.render(scene, integrator=integrator, spp=spp))
                means.append(image[..., :3].mean())
            assert means[0] == pytest.approx(means[1], rel=0.02)


class TestChanges:
    def test_a_change_is_a_new_environment(self):
        """Of the set, its place and its brightness."""
        first, second = sky(seed=0), sky(seed=0)
        second.color *= 0.5
        second.mean += 1.5
        emitter = mi.load_dict(environment_of(first))
        parameters = mi.traverse(emitter)
        parameters["color"] = mi.TensorXf(second.color.numpy().T)
        parameters["mean"] = mi.TensorXf(second.mean.numpy().T)
        parameters["to_world"] = mi.AffineTransform4f(turn())
        parameters["scale"] = mi.Float(2)
        parameters.update()
        expected = mi.load_dict(environment_of(second, to_world=turn(), scale=2.0))
        np.testing.assert_allclose(seen(emitter, texels()), seen(expected, texels()), rtol=1e-4)
        it, sample = dr.zeros(mi.Interaction3f, 500), uniform(500)
        a, b = (np.array(e.sample_direction(it, sample)[0].d) for e in (emitter, expected))
        np.testing.assert_allclose(a, b, atol=1e-4)
        again = gaussians_of({f"sky.{k}": v for k, v in parameters}, "sky", first)
        np.testing.assert_array_equal(again.mean.numpy(), second.mean.numpy())


def test_a_file_beside_the_scene_is_read(tmp_path):
    sky().save(tmp_path / "sky.npz")
    scene = tmp_path / "scene.xml"
    scene.write_text(
        '<scene version="3.0.0"><emitter type="gaussian_environment">'
        '<string name="filename" value="sky.npz"/><float name="scale" value="2"/>'
        '<string name="memory" value="exact"/>'
        '<transform name="to_world"><rotate y="1" angle="70"/></transform>'
        "</emitter></scene>"
    )
    emitter = mi.load_file(str(scene)).environment()
    about_y = mi.ScalarTransform4f().rotate([0, 1, 0], 70)
    expected = mi.load_dict(environment_of(sky(), scale=2.0, to_world=about_y))
    np.testing.assert_allclose(seen(emitter, texels()), seen(expected, texels()), rtol=1e-3)
    assert 'name = "sky.npz"' in str(emitter)


class TestMistakes:
    def test_of_sets(self):
        for g, message in (
            (sky("data"), "3 channels in the space 'data'; it needs one or three of light"),
            (sky("data", channels=2), "2 channels in the space 'data'"),
            (sky(channels=4), "4 channels; use a set of 1 to 3"),
            (sky(size=(8, 1)), "8x1 pixels; it needs two along each side"),
        ):
            with pytest.raises(RuntimeError, match=message):
                mi.load_dict(environment_of(g))
        with pytest.raises(RuntimeError, match="gaussian_environment: give one of filename"):
            mi.load_dict({"type": "gaussian_environment"})
        with pytest.raises(ValueError, match="1 rows; the set and the bitmap must"):
            bake_environment(sky(), 32, 1)
        turned = mi.ScalarTransform4f().scale(2)
        with pytest.raises(RuntimeError, match="to_world scales or shears directions"):
            mi.load_dict(environment_of(sky(), to_world=turned))

"""A texture that draws itself into texels: a bitmap whose parameters are Gaussians."""

from functools import partial

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.chi_square import assert_density
from _helpers.derivatives import SIDE, SPP, check_forward_mode, check_gradients
from _helpers.families import small_model
from _helpers.frozen import check_frozen
from _helpers.light import LUMINANCE, to_linear
from _helpers.materials import material
from _helpers.sets import SIZE
from _helpers.texture import at, backend, gaussians, in_front, mi, small_scene, texture
from _helpers.variants import in_all
from eigengs_dr.plugins import follow, pixel_angle, resident_bytes, texture_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

TEXELS, PARAMETERS = 2 * SIZE[0], ["mean", "factor", "color", "background"]


def anywhere(count=500):
    """Points in the image and beyond each border."""
    uv = np.random.default_rng(0).uniform(-1.5, 2.5, (2, count)).astype(np.float32)
    return in_front(at(*(mi.Float(row) for row in uv)))


def wall(integrator, **properties):
    reflectance = texture_of(gaussians(), texels=TEXELS, **properties)
    return small_scene({"type": "diffuse", "reflectance": reflectance}, integrator, SIDE, SPP)


class TestLookups:
    @pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
    @pytest.mark.parametrize("channels", [1, 3])
    def test_and_slopes_are_those_of_a_bitmap_of_the_picture(self, wrap, channels):
        """At the native size, where a clamped one ends at the same places as at points."""
        to_uv = mi.ScalarTransform4f().scale([-1.3, 0.8, 1])  # turned, slopes of a bitmap are not
        g, properties = gaussians("data", channels), {"wrap_mode": wrap, "to_uv": to_uv}
        data = mi.TensorXf(eg.render(g).numpy())
        bitmap = {"type": "bitmap", "data": data, "raw": True, "accel": False, **properties}
        expected, found = mi.load_dict(bitmap), texture(g, texels=SIZE[0], **properties)
        for name in ("eval_1", "eval_1_grad", *(["eval_3"] if channels == 3 else [])):
            seen, wanted = (np.array(getattr(tex, name)(anywhere())) for tex in (found, expected))
            np.testing.assert_allclose(seen, wanted, atol=2e-4 * np.abs(wanted).max())

    @in_all
    def test_are_decoded_and_clamped_as_those_of_gaussians(self, variant):
        """Texels as fine as this show what points show."""
        si = anywhere()
        if mi.is_spectral:
            si.wavelengths = 550.0 + dr.zeros(type(si.wavelengths), dr.width(si.uv))
        for space in ("ycbcr", "log"):
            g = gaussians(space)
            tex, points = (texture(g, wrap_mode="mirror", texels=n) for n in (400, 0))
            np.testing.assert_allclose(np.array(tex.eval(si)), np.array(points.eval(si)), atol=2e-3)

    def test_of_two_channels_are_normals_and_lost_ones_are_0(self):
        two, si = gaussians("data", channels=2), at(mi.Float([0.2, 0.7, np.nan]), mi.Float(0.4))
        found = np.array(texture(two, texels=400).eval_3(si))
        np.testing.assert_allclose(found, np.array(texture(two).eval_3(si)), atol=1e-3)
        assert (found[:, 2] == 0).all() and found.shape[0] == 3

    def test_of_footprints_are_close_to_the_closed_form(self):
        """From those of a texel to those of the whole image; without one it is at points."""
        si, g, fine = in_front(anywhere()), gaussians("data"), {"texels": 4 * SIZE[0]}
        si.t = mi.Float(np.geomspace(0.5, 2e3, 500))
        si.t[::10] = 0.0
        exact, levels, sharp = (
            np.array(texture(g, **more).eval(si))
            for more in ({"prefilter": 0.05}, {"prefilter": 0.05, **fine}, fine)
        )
        assert np.square(levels - exact).mean() < 0.04 * np.square(sharp - exact).mean()
        np.testing.assert_array_equal(levels[:, ::10], sharp[:, ::10])

    def test_of_a_map_and_of_a_family(self, tmp_path):
        material(backend=backend()).save(tmp_path / "x.npz")
        small_model(backend()).save(tmp_path / "m.npz")
        maps = eg.Gaussians.load(tmp_path / "x.npz").maps
        files = [{"filename": str(tmp_path / "x.npz"), "map": m.name} for m in maps]
        for file in (*files, {"model": str(tmp_path / "m.npz")}):
            plugin = {"type": "gaussian_texture", **file}
            fine, points = (mi.load_dict(plugin | more) for more in ({"texels": 800}, {}))
            si = in_front(at(*(mi.Float(np.float32(np.linspace(0.1, 0.9, 50))) for _ in "uv")))
            np.testing.assert_allclose(*(np.array(t.eval_1(si)) for t in (fine, points)), atol=0.02)


class TestDerivatives:
    @pytest.mark.parametrize(("integrator", "angle"), [("direct", 0.1), ("prb", 0.0)])
    def test_are_finite_differences(self, integrator, angle):
        scene = wall(integrator, cutoff=6.0, prefilter=angle)
        check_gradients(scene, "wall.bsdf.reflectance", PARAMETERS)

    @pytest.mark.slow
    def test_in_forward_mode(self):
        scene = partial(wall, "prb", prefilter=0.1)
        check_forward_mode(scene, "wall.bsdf.reflectance", PARAMETERS)


class TestChanges:
    def test_of_some_parameters_give_the_lookups_of_a_new_texture(self):
        tex = texture(gaussians("linear"), texels=TEXELS)
        parameters = mi.traverse(tex)
        assert [key for key, _ in parameters] == [*PARAMETERS, "to_uv", "prefilter"]
        for name in (*PARAMETERS, "color"):
            before = np.array(tex.eval_3(anywhere()))
            parameters[name] = parameters[name] * 0.9
            parameters.update()
            arrays = (np.array(parameters[key]) for key in PARAMETERS[:3])
            last, options = np.array(parameters["background"]).ravel(), {"size": SIZE}
            options |= {"space": "linear", "backend": backend()}
            fresh = texture(eg.Gaussians.from_arrays(*arrays, last, **options), texels=TEXELS)
            found = np.array(tex.eval_3(anywhere()))
            np.testing.assert_allclose(found, np.array(fresh.eval_3(anywhere())), atol=1e-6)
            assert np.abs(found - before).max() > 1e-4

    def test_of_the_number_of_gaussians(self):
        tex, half = texture(gaussians(), texels=TEXELS), gaussians()[:12]
        parameters = mi.traverse(tex)
        for name, tensor in eg.to_tensors(half).items():
            parameters[name] = tensor
        parameters.update()
        expected = texture(half, texels=TEXELS).eval_3(anywhere())
        np.testing.assert_array_equal(np.array(tex.eval_3(anywhere())), np.array(expected))
        parameters["color"] = parameters["color"][:5]
        with pytest.raises(Exception, match=r"color has shape \(5, 3\), expected"):
            parameters.update()

    def test_of_the_prefilter(self):
        """By `follow`, by hand, and back to none."""
        scene = wall("direct")
        angle, none = pixel_angle(scene.sensors()[0]), np.array(mi.render(scene, seed=1))
        follow(scene)
        fixed = np.array(mi.render(wall("direct", prefilter=angle), seed=1))
        np.testing.assert_allclose(np.array(mi.render(scene, seed=1)), fixed, atol=1e-5)
        assert np.abs(fixed - none).max() > 1e-3
        parameters = mi.traverse(scene)
        for number, expected in ((0.0, none), (angle, fixed)):
            parameters["wall.bsdf.reflectance.prefilter"] = number
            parameters.update()
            np.testing.assert_allclose(np.array(mi.render(scene, seed=1)), expected, atol=1e-5)

    def test_in_frozen_renderings(self):
        """Of a wall, and of a light that was sampled before."""
        lamp = {"type": "area", "radiance": texture_of(gaussians("linear"), texels=TEXELS)}
        for scene in (wall("path", prefilter=0.1), small_scene(None, emitter=lamp)):
            mi.render(scene, spp=1)
            changes = [[n] for n in (*PARAMETERS, "prefilter")]
            check_frozen(scene, [[], *changes, PARAMETERS, ["color"], ["color"]])


class TestEmission:
    def test_chi_square(self):
        from mitsuba.chi2 import PlanarDomain

        turn = mi.ScalarTransform4f().rotate([0, 0, 1], 20) @ mi.ScalarTransform4f().scale(1.3)
        g = gaussians("linear", quiet=False)
        tex = texture(g, texels=TEXELS, wrap_mode="mirror", to_uv=turn)
        square = PlanarDomain(mi.ScalarBoundingBox2f([0, 0], [1, 1]))
        assert_density(
            lambda sample: tex.sample_position(sample)[0], tex.pdf_position, square, 200_000, 16
        )

    def test_its_mean_and_maximum_are_those_of_the_texels(self):
        g = gaussians("ycbcr", quiet=False)
        light = to_linear(np.clip(eg.render(g, TEXELS).numpy(), 0, 1)) @ LUMINANCE
        tex = texture(g, texels=TEXELS, prefilter=0.1)
        assert np.array(tex.mean()).item() == pytest.approx(light.mean(), rel=1e-4)
        assert tex.max() == pytest.approx(light.max(), rel=1e-4)


@pytest.mark.parametrize(
    ("properties", "message"),
    [
        ({"texels": -1}, "texels is -1; it must be a number of texels"),
        ({"texels": 2.5}, "texels is 2.5; it must be a number of texels"),
        ({"texels": 8, "memory": "small"}, "texels have no memory; give one"),
    ],
)
def test_mistakes(properties, message):
    with pytest.raises(RuntimeError) as caught:
        texture(gaussians(), **properties)
    assert f"gaussian_texture: {message}" in str(caught.value).splitlines()[0]


@pytest.mark.parametrize(("channels", "size"), [(1, 8), (3, 16)])
def test_bytes_of_a_texel(channels, size):
    """Levels take a third more."""
    for angle, levels in ((0.0, 1), (0.1, 4 / 3)):
        tex = texture(gaussians("data", channels), texels=500, prefilter=angle)
        assert resident_bytes(tex) == pytest.approx(size * 500 * 386 * levels, rel=0.01)
        assert "resolution = [500, 386]" in str(tex) and "texels = 500" in str(tex)

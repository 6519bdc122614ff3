"""The texture in Mitsuba: values, wrapping, colour, slots of scenes, sampling, mistakes."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from _helpers.sets import COUNT, SIZE

mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")
import eigengs_dr as eg  # noqa: E402
from _helpers.texture import at, gaussians, picture, small_scene, texel_centres, texture  # noqa: E402
from _helpers.variants import BOTH_RGB, on_both  # noqa: E402
from eigengs_dr.image.color import to_linear  # noqa: E402
from eigengs_dr.plugins import texture_of  # noqa: E402
from eigengs_dr.raster.render import picture_of  # noqa: E402

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

MONO, SPECTRAL = on_both("mono"), on_both("spectral")


def in_variants(names):
    return pytest.mark.parametrize("variant", names, indirect=True)


others = [
    pytest.param(name, marks=pytest.mark.slow) for name in ("llvm_ad_mono", "llvm_ad_spectral")
]
in_all = in_variants([*BOTH_RGB, *MONO, *SPECTRAL])


def test_first_so_many_of_a_file(tmp_path):
    gaussians().save(tmp_path / "x.npz")
    plain = {"type": "gaussian_texture", "filename": str(tmp_path / "x.npz")}
    assert mi.traverse(mi.load_dict({**plain, "first": 7}))["mean"].shape == (7, 2)
    assert mi.traverse(mi.load_dict(plain))["mean"].shape == (COUNT, 2)
    for wrong in (-1, True, 2.5):
        with pytest.raises(RuntimeError, match="must be a number of Gaussians"):
            mi.load_dict({**plain, "first": wrong})


class TestValues:
    @pytest.mark.parametrize("space", ["ycbcr", "rgb", "linear", "data"])
    def test_raw_is_what_render_gives(self, space):
        g = gaussians(space, quiet=False)
        found = picture(texture(g, raw=True).eval_3(texel_centres()))
        np.testing.assert_allclose(found, eg.render(g).numpy(), atol=1e-5)

    @pytest.mark.parametrize("space", ["ycbcr", "rgb", "linear", "data"])
    def test_colours_are_clamped_and_decoded(self, space):
        g = gaussians(space, quiet=False)
        shown = np.clip(eg.render(g).numpy(), 0, 1)
        expected = to_linear(shown) if space in ("ycbcr", "rgb") else shown
        found = picture(texture(g).eval(texel_centres()))
        np.testing.assert_allclose(found, expected, atol=1e-5)

    @pytest.mark.parametrize("space", ["radiance", "log"])
    def test_light_above_1_is_not_clamped(self, space):
        g = gaussians(space, quiet=False)
        rendered = eg.render(g).numpy()
        assert rendered.max() > 1.5 and rendered.min() < 0
        found = picture(texture(g).eval(texel_centres()))
        np.testing.assert_allclose(found, np.maximum(rendered, 0), rtol=1e-4, atol=1e-4)

    @pytest.mark.parametrize("space", ["linear", "radiance", "log"])
    def test_slopes_of_light(self, space):
        g = gaussians(space)
        t, step = texture(g), 1e-3
        found = t.eval_1_grad(at(mi.Float(0.4), mi.Float(0.6)))
        sides = [t.eval_1(at(mi.Float(0.4 + d), mi.Float(0.6))).numpy() for d in (-step, step)]
        slope = (sides[1] - sides[0]) / (2 * step)
        np.testing.assert_allclose(found[0].numpy(), slope, rtol=0.05, atol=0.02)

    def test_normals_get_the_length_1_unless_raw(self):
        g = gaussians("normal", quiet=False)
        found = picture(texture(g).eval_3(texel_centres()))
        np.testing.assert_allclose(np.linalg.norm(2 * found - 1, axis=2), 1, atol=1e-5)
        np.testing.assert_allclose(found, eg.render(g).numpy(), atol=1e-4)
        raw = picture(texture(g, raw=True).eval_3(texel_centres()))
        plain = eg.render(replace(g, space="data")).numpy()
        np.testing.assert_allclose(raw, plain, atol=1e-5)

    def test_a_set_in_linear_light_shows_the_picture(self):
        g = gaussians("linear")
        found = picture(texture(g).eval(texel_centres()))
        np.testing.assert_allclose(found, to_linear(picture_of(g)), atol=1e-5)

    @in_all
    def test_one_channel_is_a_number(self, variant):
        g = gaussians("data", channels=1)
        si = texel_centres()
        si.wavelengths = (
            550.0 + dr.zeros(type(si.wavelengths), dr.width(si))
            if (mi.is_spectral)
            else si.wavelengths
        )
        expected = eg.render(g).numpy()
        tex = texture(g)
        np.testing.assert_allclose(picture([tex.eval_1(si)]), expected, atol=1e-5)
        np.testing.assert_allclose(picture([tex.eval(si)[0]]), expected, atol=1e-5)

    @in_variants(MONO)
    def test_mono_shows_luminance(self, variant):
        g = gaussians("rgb")
        light = to_linear(eg.render(g).numpy()) @ np.float32([0.212671, 0.715160, 0.072169])
        found = picture([texture(g).eval(texel_centres())[0]])[..., 0]
        np.testing.assert_allclose(found, light, atol=1e-5)

    @in_variants(SPECTRAL)
    def test_spectral_integrates_to_the_colour(self, variant):
        g = gaussians("rgb")
        lit = {
            "type": "scene",
            "integrator": {"type": "direct", "bsdf_samples": 1, "emitter_samples": 0},
            "sensor": {
                "type": "orthographic",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
            },
            "wall": {
                "type": "rectangle",
                "bsdf": {
                    "type": "diffuse",
                    "reflectance": {**texture_of(g), "to_uv": flat_middle()},
                },
            },
            "light": {"type": "constant"},
        }
        scene = mi.load_dict(lit)
        colour = np.array(mi.render(scene, spp=512)).mean(axis=(0, 1))
        mi.set_variant(variant.replace("spectral", "rgb"))
        expected = np.array(texture(g, to_uv=flat_middle()).eval(at(0.5, 0.5))).ravel()
        mi.set_variant(variant)
        np.testing.assert_allclose(colour, expected, rtol=0.02)

    @pytest.mark.parametrize("seed", range(3))
    def test_a_saved_set_is_the_same_texture(self, tmp_path, seed):
        g = gaussians("ycbcr", seed=seed)
        g.save(tmp_path / "x.npz")
        loaded = mi.load_dict({"type": "gaussian_texture", "filename": str(tmp_path / "x.npz")})
        np.testing.assert_array_equal(
            picture(loaded.eval(texel_centres())), picture(texture(g).eval(texel_centres()))
        )

    def test_what_it_says_of_itself(self):
        g = gaussians("rgb", quiet=False)
        tex = texture(g, wrap_mode="mirror", cutoff=4.0)
        assert tuple(tex.resolution()) == SIZE
        assert tex.is_spatially_varying()
        assert "mirror" in str(tex)
        light = to_linear(np.clip(eg.render(g, 220, cutoff=4).numpy(), 0, 1))
        luminance = light @ np.float32([0.212671, 0.715160, 0.072169])
        assert np.array(tex.mean()) == pytest.approx(luminance.mean(), abs=0.01)
        assert tex.max() == pytest.approx(luminance.max(), abs=0.02)


def flat_middle():
    """A uv transform under which all of [0, 1]^2 sees almost one point."""
    return mi.ScalarTransform4f().translate([0.5, 0.5, 0]) @ mi.ScalarTransform4f().scale(1e-4)


class TestWhere:
    @pytest.mark.parametrize(
        ("wrap", "inside"),
        [("repeat", [0.8, 0.25]), ("mirror", [0.2, 0.75]), ("clamp", [0.0, 1.0])],
    )
    def test_outside_of_the_image(self, wrap, inside):
        tex = texture(gaussians(), wrap_mode=wrap)
        found = np.array(tex.eval(at(mi.Float(-0.2), mi.Float(1.25))))
        expected = np.array(tex.eval(at(mi.Float(inside[0]), mi.Float(inside[1]))))
        np.testing.assert_allclose(found, expected, atol=1e-5)

    @pytest.mark.parametrize("dimensions", [3, 4])
    def test_to_uv_comes_first(self, dimensions):
        kind = mi.ScalarTransform3f if dimensions == 3 else mi.ScalarTransform4f
        shift = [0.1, 0.2] if dimensions == 3 else [0.1, 0.2, 0]
        scale = [0.5, 0.25] if dimensions == 3 else [0.5, 0.25, 1]
        tex = texture(gaussians(), to_uv=kind().translate(shift) @ kind().scale(scale))
        found = np.array(tex.eval(at(0.4, 0.8)))
        expected = np.array(texture(gaussians()).eval(at(0.3, 0.4)))
        np.testing.assert_allclose(found, expected, atol=1e-5)

    @pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
    @pytest.mark.parametrize("prefilter", [0.0, 0.001])
    def test_no_uv_makes_a_nan(self, wrap, prefilter):
        wild = [1e-30, 1e6, -1e6, 1e30, -1e30, np.inf, -np.inf, np.nan]
        u, v = np.meshgrid(np.float32(wild), np.float32(wild))
        si = at(mi.Float(u.ravel()), mi.Float(v.ravel()))
        si.t, si.wi = 10.0, mi.Vector3f(0, 0, 1)
        si.sh_frame = mi.Frame3f([0, 0, 1])
        si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
        tex = texture(gaussians(), wrap_mode=wrap, prefilter=prefilter)
        found = np.array(tex.eval(si))
        assert np.isfinite(found).all()
        lost = ~(np.isfinite(u) & np.isfinite(v)).ravel()
        assert (found[:, lost] == 0).all()
        assert np.isfinite(np.array(tex.eval_1_grad(si))).all()


class TestSlope:
    @pytest.mark.parametrize("space", ["data", "rgb", "ycbcr"])
    @pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
    def test_is_a_finite_difference(self, space, wrap):
        turn = mi.ScalarTransform4f().rotate([0, 0, 1], 30) @ mi.ScalarTransform4f().scale(0.7)
        tex = texture(gaussians(space), to_uv=turn, wrap_mode=wrap, cutoff=7.0)
        uv = np.float32(np.random.default_rng(0).uniform(-0.5, 1.5, (2, 200)))
        found = np.array(tex.eval_1_grad(at(*(mi.Float(k) for k in uv))))
        h = 2e-3
        for axis in (0, 1):
            step = np.zeros((2, 1), np.float32)
            step[axis] = h
            up, down = (
                np.array(tex.eval_1(at(*(mi.Float(k) for k in uv + s * step)))) for s in (1, -1)
            )
            expected = (up - down) / (2 * h)
            close = np.abs(found[axis] - expected) < 0.05 * np.abs(expected).max()
            assert close.mean() > 0.97  # all but those whose step crosses a border

    def test_where_values_are_clamped_there_is_none(self):
        g = gaussians("data", quiet=False)
        g.color *= 100
        tex = texture(g)
        value = np.array(tex.eval_1(texel_centres()))
        slope = np.array(tex.eval_1_grad(texel_centres()))
        assert (slope[:, value == 0] == 0).all()


SLOTS = ["diffuse", "principled", "roughconductor", "roughdielectric", "plastic", "roughplastic"]
SLOTS += ["blend", "mask", "normalmap", "bumpmap"]


def slots(g):
    """BSDFs with a texture in every kind of place that Mitsuba has for one, by name."""
    colour, number = texture_of(g), texture_of(gaussians("data", channels=1))
    diffuse = {"type": "diffuse"}
    return {
        "diffuse": {"type": "diffuse", "reflectance": colour},
        "principled": {"type": "principled", "base_color": colour, "roughness": number},
        "roughconductor": {"type": "roughconductor", "alpha": number},
        "roughdielectric": {"type": "roughdielectric", "alpha": number},
        "plastic": {"type": "plastic", "diffuse_reflectance": colour},
        "roughplastic": {"type": "roughplastic", "diffuse_reflectance": colour},
        "blend": {
            "type": "blendbsdf",
            "weight": number,
            "a": diffuse,
            "b": {"type": "diffuse", "reflectance": 0.1},
        },
        "mask": {"type": "mask", "opacity": number, "inner": diffuse},
        "normalmap": {
            "type": "normalmap",
            "normalmap": texture_of(gaussians("data")),
            "inner": diffuse,
        },
        "bumpmap": {"type": "bumpmap", "bump": number, "scale": 3.0, "inner": diffuse},
    }


class TestSlots:
    @in_variants([*BOTH_RGB, *others])
    @pytest.mark.parametrize("name", SLOTS)
    def test_renders_and_differentiates(self, variant, name):
        """In every slot the picture is finite, changes with the texture, and has a gradient."""
        scene = small_scene(slots(gaussians())[name], "direct")
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

    @in_all
    def test_lights(self, variant):
        radiance = texture_of(gaussians("linear"))
        if mi.is_spectral:
            radiance = {"type": "d65", "of": radiance}  # else it glows at equal energy
        emitter = {"type": "area", "radiance": radiance}
        scene = small_scene(None, "path", emitter=emitter)
        parameters = mi.traverse(scene)
        key = next(k for k, _ in parameters if k.endswith(".color"))
        dr.enable_grad(parameters[key])
        parameters.update()
        image = mi.render(scene, params=parameters, spp=4)
        assert np.isfinite(np.array(image)).all()
        dr.backward(dr.mean(image))
        assert np.abs(np.array(dr.grad(parameters[key]))).max() > 0

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

    def test_a_lamp_lights_as_a_bitmap_of_the_same_picture_does(self):
        g = gaussians("linear", quiet=False)
        data = mi.TensorXf(np.clip(eg.render(g, SIZE[0] * 8).numpy(), 0, 1))
        means = []
        for radiance in (
            texture_of(g),
            {"type": "bitmap", "data": data, "raw": True, "wrap_mode": "clamp"},
        ):
            scene = small_scene(None, emitter={"type": "area", "radiance": radiance})
            means.append(np.array(mi.render(scene, spp=256, seed=1)).mean(axis=(0, 1)))
        np.testing.assert_allclose(means[0], means[1], rtol=0.02)


class TestSampling:
    @pytest.mark.parametrize("wrap", ["repeat", "mirror"])
    def test_chi_square(self, wrap):
        """Mitsuba's own test, of positions against their density."""
        from mitsuba.chi2 import ChiSquareTest, PlanarDomain

        turn = mi.ScalarTransform4f().rotate([0, 0, 1], 20) @ mi.ScalarTransform4f().scale(1.3)
        tex = texture(gaussians("linear", quiet=False), wrap_mode=wrap, to_uv=turn)
        test = ChiSquareTest(
            domain=PlanarDomain(mi.ScalarBoundingBox2f([0, 0], [1, 1])),
            sample_func=lambda sample: tex.sample_position(sample)[0],
            pdf_func=tex.pdf_position,
            sample_dim=2,
            sample_count=200_000,
            res=64,
            ires=16,
        )
        assert test.run(), test.messages

    def test_density_is_what_sampling_says(self):
        tex = texture(gaussians("linear", quiet=False))
        sample = mi.Point2f(
            *(mi.Float(k) for k in np.float32(np.random.default_rng(0).random((2, 1000))))
        )
        position, density = tex.sample_position(sample)
        found = np.array(tex.pdf_position(position))
        agree = np.isclose(found, np.array(density), rtol=1e-4)
        assert agree.mean() > 0.99  # some samples round to the edge of a cell
        assert (np.array(density) > 0).all()

    def test_follows_the_parameters(self):
        tex = texture(gaussians("linear"))
        point = mi.Point2f(0.2, 0.2)
        assert np.array(tex.pdf_position(point)) == pytest.approx(1, abs=0.3)
        parameters = mi.traverse(tex)
        bright = np.array(parameters["color"])
        near = np.argsort(np.hypot(*(np.array(parameters["mean"]) - 0.8 * np.array(SIZE)).T))[:4]
        bright[near] = 1
        parameters["color"] = mi.TensorXf(bright)
        parameters["background"] = mi.TensorXf(np.zeros(3, np.float32))
        parameters.update()
        assert np.array(tex.pdf_position(point)) < 0.5

    def test_what_is_below_zero_is_not_sampled(self):
        """Of a raw texture, whose values are not clamped."""
        g = gaussians("linear")
        g.color *= 0
        g.background *= -1
        density = np.array(texture(g, raw=True).pdf_position(mi.Point2f(0.3, 0.7)))
        assert density == pytest.approx(1)
        g = gaussians("linear", quiet=False)
        g.background *= 0
        g.color *= 5
        tex = texture(g, raw=True)
        dark = np.array(tex.eval_1(texel_centres())) < -1
        density = np.array(tex.pdf_position(texel_centres().uv))
        assert dark.any()
        assert density[dark].max() < 0.1 * density.max()

    def test_outside_there_is_no_density(self):
        tex = texture(gaussians("linear"))
        assert np.array(tex.pdf_position(mi.Point2f(1.5, 0.5))) == 0

    def test_a_black_picture_is_sampled_evenly(self):
        g = gaussians("linear")
        g.color *= 0
        g.background *= 0
        assert np.array(texture(g).pdf_position(mi.Point2f(0.3, 0.7))) == pytest.approx(1)


class TestMistakes:
    @pytest.mark.parametrize(
        ("properties", "message"),
        [
            ({"filename": "nowhere.npz"}, "nowhere.npz"),
            ({}, "give one of filename"),
            ({"filename": "a.npz", "model": "b.npz"}, "give one of filename"),
        ],
    )
    def test_of_where_from(self, properties, message):
        with pytest.raises(RuntimeError, match=message):
            mi.load_dict({"type": "gaussian_texture", **properties})

    @pytest.mark.parametrize(
        ("properties", "message"),
        [
            ({"wrap_mode": "bounce"}, "wrap_mode 'bounce' is unknown; use one of repeat, mirror"),
            ({"cutoff": 0.0}, "cutoff is 0.0; it must be above 0 and at most 12"),
            ({"prefilter": -1.0}, "prefilter is -1.0; it is the angle of a pixel"),
            ({"prefiltre": 1.0}, "prefiltre"),
            ({"space": "cmyk"}, "space 'cmyk'"),
            ({"raw": "false"}, "raw is 'false'; it must be a boolean"),
            ({"cutoff": "wide"}, "cutoff is 'wide'; it must be a number"),
            ({"prefilter": True}, "prefilter is True; it must be a number"),
            ({"width": 31.5}, "width is 31.5; it must be an integer"),
            ({"to_uv": 2.0}, "to_uv is 2.0; it must be a transform"),
        ],
    )
    def test_of_properties(self, properties, message):
        with pytest.raises(RuntimeError, match=message):
            texture(gaussians(), **properties)

    def test_a_transform_that_is_flat(self):
        with pytest.raises(RuntimeError, match="to_uv maps the plane to a line"):
            texture(gaussians(), to_uv=mi.ScalarTransform4f(np.diag([1.0, 0, 1, 1])))

    def test_a_small_transform_is_not_flat(self):
        tiny = mi.ScalarTransform4f().scale([1e-7, 1e-7, 1])
        found = texture(gaussians(), to_uv=tiny).eval(at(0.5, 0.5))
        np.testing.assert_allclose(found, texture(gaussians()).eval(at(5e-8, 5e-8)), atol=1e-5)

    @pytest.mark.parametrize("channels", [2, 4])
    def test_a_set_of_other_channels(self, channels):
        with pytest.raises(RuntimeError, match=f"has {channels} channels; use a set of 1 or 3"):
            texture(gaussians("data", channels=channels))

    def test_an_array_that_is_missing(self):
        properties = texture_of(gaussians())
        del properties["color"]
        with pytest.raises(RuntimeError, match="color is missing"):
            mi.load_dict(properties)

    def test_a_file_that_is_no_set(self, tmp_path):
        (tmp_path / "x.npz").write_bytes(b"nothing")
        with pytest.raises(RuntimeError, match=r"x\.npz"):
            mi.load_dict({"type": "gaussian_texture", "filename": str(tmp_path / "x.npz")})

    def test_normals_from_one_channel(self):
        with pytest.raises(ValueError, match="a lookup of three channels"):
            texture(gaussians("data", channels=1)).eval_3(at(0.5, 0.5))

    @in_variants(SPECTRAL)
    @pytest.mark.parametrize("raw", [True, False])
    def test_a_spectrum_from_data(self, variant, raw):
        tex = texture(gaussians("rgb" if raw else "data"), raw=raw)
        with pytest.raises(ValueError, match="not raw data"):
            tex.eval(at(0.5, 0.5))

    @in_variants(["scalar_rgb"])
    def test_scalar_variants(self, variant):
        with pytest.raises(RuntimeError, match="does not support the variant scalar_rgb; use"):
            mi.load_dict({"type": "gaussian_texture", "filename": "x.npz"})

    def test_parameters_of_another_shape(self):
        tex = texture(gaussians())
        parameters = mi.traverse(tex)
        parameters["color"] = mi.TensorXf(np.zeros((3, 3), np.float32))
        with pytest.raises(Exception, match=r"color has shape \(3, 3\), expected \(24, 3\)"):
            parameters.update()

"""Lookups of a texture: values, colour, wrapping, slopes, `to_uv`."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.light import LUMINANCE, to_linear
from _helpers.sets import SIZE
from _helpers.texture import at, gaussians, in_front, mi, picture, texel_centres, texture
from _helpers.variants import in_all

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]


class TestValues:
    @pytest.mark.parametrize("space", ["ycbcr", "linear"])
    def test_are_what_render_gives_clamped_and_decoded_unless_raw(self, space):
        g = gaussians(space, quiet=False)
        rendered = eg.render(g).numpy()
        raw = picture(texture(g, raw=True).eval_3(texel_centres()))
        np.testing.assert_allclose(raw, rendered, atol=1e-5)
        shown = np.clip(rendered, 0, 1)
        expected = to_linear(shown) if space == "ycbcr" else shown
        found = picture(texture(g).eval(texel_centres()))
        np.testing.assert_allclose(found, expected, atol=1e-5)

    @pytest.mark.parametrize(("space", "outside", "sign"), [("linear", 1.7, 1), ("rgb", -0.4, -1)])
    def test_derivatives_of_clamped_colours_lead_back_into_the_range(self, space, outside, sign):
        g = gaussians(space)
        g.background = dr.full(type(g.background), outside, (3, 1))
        tex = texture(g)
        parameters = mi.traverse(tex)
        dr.enable_grad(parameters["background"])
        parameters.update()
        value = tex.eval_1(at(0.5, 0.5))
        assert np.array(value) == pytest.approx(1 if sign > 0 else 0, abs=1e-6)
        dr.backward(dr.square(value - 0.5))
        assert (np.sign(np.array(dr.grad(parameters["background"]))) == sign).all()

    @pytest.mark.parametrize("space", ["radiance", "log"])
    def test_light_above_1_is_not_clamped(self, space):
        g = gaussians(space, quiet=False)
        rendered = eg.render(g).numpy()
        assert rendered.max() > 1.5 and rendered.min() < 0
        found = picture(texture(g).eval(texel_centres()))
        np.testing.assert_allclose(found, np.maximum(rendered, 0), rtol=1e-4, atol=1e-4)

    def test_normals_get_the_length_1_unless_raw(self):
        g = gaussians("normal", quiet=False)
        found = picture(texture(g).eval_3(texel_centres()))
        np.testing.assert_allclose(np.linalg.norm(2 * found - 1, axis=2), 1, atol=1e-5)
        np.testing.assert_allclose(found, eg.render(g).numpy(), atol=1e-4)
        raw = picture(texture(g, raw=True).eval_3(texel_centres()))
        np.testing.assert_allclose(raw, eg.render(replace(g, space="data")).numpy(), atol=1e-5)

    @in_all
    def test_one_channel_is_a_number_and_mono_shows_luminance(self, variant):
        number, colour, si = gaussians("data", channels=1), gaussians("rgb"), texel_centres()
        if mi.is_spectral:
            si.wavelengths = 550.0 + dr.zeros(type(si.wavelengths), dr.width(si))
        expected, tex = eg.render(number).numpy(), texture(number)
        np.testing.assert_allclose(picture([tex.eval_1(si)]), expected, atol=1e-5)
        np.testing.assert_allclose(picture([tex.eval(si)[0]]), expected, atol=1e-5)
        if mi.is_monochromatic:
            light = to_linear(eg.render(colour).numpy()) @ LUMINANCE
            found = picture([texture(colour).eval(si)[0]])[..., 0]
            np.testing.assert_allclose(found, light, atol=1e-5)


class TestWhere:
    @pytest.mark.parametrize(
        ("wrap", "prefilter"),
        [("repeat", 0.0), ("mirror", 0.0), ("clamp", 0.0), ("clamp", 1e-6)],
    )
    def test_outside_of_the_image_it_is_as_a_bitmap(self, wrap, prefilter):
        """Clamped, also further out than the centres of pixels, where Gaussians fall off."""
        g = gaussians("data")
        data = mi.TensorXf(eg.render(g).numpy())
        bitmap = {"type": "bitmap", "data": data, "filter_type": "nearest", "wrap_mode": wrap}
        bitmap |= {"raw": True, "accel": False}  # in hardware, fractions of texels have 8 bits
        u, v = (np.arange(-side, 3 * side) + 0.5 for side in SIZE)
        u = np.append(u, [-0.3, 0.1] if wrap == "clamp" else [])
        u, v = np.meshgrid(u / SIZE[0], v / SIZE[1])
        si = in_front(at(*(mi.Float(np.float32(k.ravel())) for k in (u, v))))
        expected = np.array(mi.load_dict(bitmap).eval(si))
        found = np.array(texture(g, wrap_mode=wrap, prefilter=prefilter).eval(si))
        np.testing.assert_allclose(found, expected, atol=1e-3)

    @pytest.mark.parametrize(("wrap", "prefilter"), [("mirror", 0.0), ("clamp", 0.001)])
    def test_no_uv_makes_a_nan(self, wrap, prefilter):
        wild = [1e-30, 1e6, -1e6, 1e30, -1e30, np.inf, -np.inf, np.nan]
        u, v = np.meshgrid(np.float32(wild), np.float32(wild))
        si = in_front(at(mi.Float(u.ravel()), mi.Float(v.ravel())), 10.0)
        tex = texture(gaussians(), wrap_mode=wrap, prefilter=prefilter)
        found = np.array(tex.eval(si))
        assert np.isfinite(found).all()
        lost = ~(np.isfinite(u) & np.isfinite(v)).ravel()
        assert (found[:, lost] == 0).all()
        assert np.isfinite(np.array(tex.eval_1_grad(si))).all()

    @pytest.mark.parametrize("prefilter", [0.0, 0.02, 0.2, 0.9])
    def test_lanes_that_are_inactive_or_have_no_uv_are_zero(self, prefilter):
        """A point, footprints in lists and in the pyramid, and one that sees the mean alone."""
        tex = texture(gaussians(), prefilter=prefilter)
        si = at(mi.Float([0.2, 0.4, 0.4, np.nan, np.inf]), mi.Float([0.3, 0.6, 0.6, 0.9, 0.9]))
        one = np.array(tex.eval(in_front(si)))
        found = np.array(tex.eval(si, mi.Bool([True, False, True, True, False])))
        assert one[:, :3].min() > 0 and not one[:, 3:].any()
        np.testing.assert_allclose(found, one * [1, 0, 1, 1, 1], atol=1e-6)


class TestSlope:
    @pytest.mark.parametrize(
        ("space", "wrap"),
        [("linear", "mirror"), ("linear", "clamp"), ("log", "repeat")],
    )
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


class TestTransform:
    @pytest.mark.parametrize("name", ["ScalarTransform3f", "Transform4f"])
    def test_comes_first(self, name):
        kind, flat = getattr(mi, name), name.endswith("3f")
        shift = [0.1, 0.2] if flat else [0.1, 0.2, 0]
        scale = [0.5, 0.25] if flat else [0.5, 0.25, 1]
        tex = texture(gaussians(), to_uv=kind().translate(shift) @ kind().scale(scale))
        found = np.array(tex.eval(at(0.4, 0.8)))
        expected = np.array(texture(gaussians()).eval(at(0.3, 0.4)))
        np.testing.assert_allclose(found, expected, atol=1e-5)

    def test_a_small_one_is_not_flat(self):
        tiny = mi.ScalarTransform4f().scale([1e-7, 1e-7, 1])
        found = texture(gaussians(), to_uv=tiny).eval(at(0.5, 0.5))
        np.testing.assert_allclose(found, texture(gaussians()).eval(at(5e-8, 5e-8)), atol=1e-5)

    @pytest.mark.parametrize("prefilter", [pytest.param(0.0, marks=pytest.mark.slow), 0.01])
    def test_is_a_parameter(self, prefilter):
        """After an update lookups, slopes and sampling are those of a texture made so."""
        changed, turned = (
            texture(gaussians(), prefilter=prefilter, **properties)
            for properties in ({}, {"to_uv": mi.ScalarTransform4f().rotate([0, 0, 1], 30)})
        )
        parameters = mi.traverse(changed)
        assert type(parameters["to_uv"]) is mi.ScalarTransform3f
        changed.sample_position(mi.Point2f(0.2, 0.7))
        parameters["to_uv"] = mi.ScalarTransform3f().rotate(30)
        parameters.update()
        uv = np.random.default_rng(0).uniform(-1, 2, (2, 100)).astype(np.float32)
        si = in_front(at(*(mi.Float(k) for k in uv)), 5.0)
        for found, expected in (
            (changed.eval(si), turned.eval(si)),
            (changed.eval_1_grad(si), turned.eval_1_grad(si)),
            (changed.pdf_position(si.uv), turned.pdf_position(si.uv)),
        ):
            np.testing.assert_allclose(np.array(found), np.array(expected), atol=2e-5)


def test_a_branch_that_ended_lends_nothing():
    """A lookup in a branch, and the same one after it, are two."""
    tex = texture(gaussians())
    si = at(mi.Float([0.2, 0.5, 0.7]), mi.Float([0.3, 0.6, 0.9]))

    def seen():
        return mi.Color3f(tex.eval(si))

    def body(i, total):
        inner = dr.if_stmt(
            (), si.uv.x > 0.4, lambda: seen(), lambda: mi.Color3f(0), mode="symbolic"
        )
        return i + 1, total + inner + seen()

    start = (mi.UInt32(0), mi.Color3f(0) + dr.zeros(mi.Float, 3))
    total = dr.while_loop(start, lambda i, total: i < 2, body, mode="symbolic")[1]
    once = np.array(tex.eval(si))
    expected = 2 * once + 2 * once * (np.array(si.uv.x) > 0.4)
    np.testing.assert_allclose(np.array(total), expected, atol=1e-6)

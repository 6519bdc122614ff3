"""Lookups of the texture: values, colour, wrapping, slopes."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.sets import COUNT, SIZE
from _helpers.texture import at, gaussians, in_front, mi, picture, texel_centres, texture
from _helpers.variants import in_all, in_variants, on_both
from eigengs_dr.image.color import to_linear

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]


def test_first_so_many_of_a_file(tmp_path):
    gaussians().save(tmp_path / "x.npz")
    plain = {"type": "gaussian_texture", "filename": str(tmp_path / "x.npz")}
    assert mi.traverse(mi.load_dict({**plain, "first": 7}))["mean"].shape == (7, 2)
    assert mi.traverse(mi.load_dict(plain))["mean"].shape == (COUNT, 2)
    for wrong in (-1, True, 2.5):
        with pytest.raises(RuntimeError, match="must be a number of Gaussians"):
            mi.load_dict({**plain, "first": wrong})
    more = f"first is {COUNT + 1}; the file has {COUNT} Gaussians"
    with pytest.raises(RuntimeError, match=more):
        mi.load_dict({**plain, "first": COUNT + 1})


class TestValues:
    @pytest.mark.parametrize("space", ["ycbcr", "rgb", "linear", "data"])
    def test_are_what_render_gives_clamped_and_decoded_unless_raw(self, space):
        g = gaussians(space, quiet=False)
        rendered = eg.render(g).numpy()
        raw = picture(texture(g, raw=True).eval_3(texel_centres()))
        np.testing.assert_allclose(raw, rendered, atol=1e-5)
        shown = np.clip(rendered, 0, 1)
        expected = to_linear(shown) if space in ("ycbcr", "rgb") else shown
        found = picture(texture(g).eval(texel_centres()))
        np.testing.assert_allclose(found, expected, atol=1e-5)

    @pytest.mark.parametrize("space", ["linear", "rgb"])
    @pytest.mark.parametrize(("outside", "sign"), [(1.7, 1), (-0.4, -1)])
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
        plain = eg.render(replace(g, space="data")).numpy()
        np.testing.assert_allclose(raw, plain, atol=1e-5)

    @in_all
    def test_one_channel_is_a_number(self, variant):
        g = gaussians("data", channels=1)
        si = texel_centres()
        if mi.is_spectral:
            si.wavelengths = 550.0 + dr.zeros(type(si.wavelengths), dr.width(si))
        expected = eg.render(g).numpy()
        tex = texture(g)
        np.testing.assert_allclose(picture([tex.eval_1(si)]), expected, atol=1e-5)
        np.testing.assert_allclose(picture([tex.eval(si)[0]]), expected, atol=1e-5)

    @in_variants(on_both("mono"))
    def test_mono_shows_luminance(self, variant):
        g = gaussians("rgb")
        light = to_linear(eg.render(g).numpy()) @ np.float32([0.212671, 0.715160, 0.072169])
        found = picture([texture(g).eval(texel_centres())[0]])[..., 0]
        np.testing.assert_allclose(found, light, atol=1e-5)


class TestWhere:
    @pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
    @pytest.mark.parametrize("prefilter", [0.0, 1e-6])
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

    @pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
    @pytest.mark.parametrize("prefilter", [0.0, 0.001])
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


class TestSlope:
    @pytest.mark.parametrize(
        ("space", "wrap"),
        [
            *(("rgb", wrap) for wrap in ("repeat", "mirror", "clamp")),
            *((space, "repeat") for space in ("data", "ycbcr", "linear", "radiance", "log")),
        ],
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


@pytest.mark.parametrize("prefilter", [0.0, 0.02, 0.2, 0.9])
def test_lanes_that_are_inactive_or_have_no_uv_are_zero(prefilter):
    """A point, footprints in lists and in the pyramid, and one that sees the mean alone."""
    tex = texture(gaussians(), prefilter=prefilter)
    si = at(mi.Float([0.2, 0.4, 0.4, np.nan, np.inf]), mi.Float([0.3, 0.6, 0.6, 0.9, 0.9]))
    one = np.array(tex.eval(in_front(si)))
    found = np.array(tex.eval(si, mi.Bool([True, False, True, True, False])))
    assert one[:, :3].min() > 0 and not one[:, 3:].any()
    np.testing.assert_allclose(found, one * [1, 0, 1, 1, 1], atol=1e-6)

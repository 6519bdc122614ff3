"""Sampled emission of the texture, its mean and its maximum."""

import numpy as np
import pytest

from _helpers.sets import SIZE

mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")
from _helpers.texture import gaussians, texel_centres, texture  # noqa: E402

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]


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

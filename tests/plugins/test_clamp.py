"""Values that a texture clamps: their derivatives lead back into the range."""

import drjit as dr
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")
from _helpers.texture import at, gaussians, texture  # noqa: E402

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]


class TestClamp:
    @pytest.mark.parametrize("space", ["linear", "rgb"])
    @pytest.mark.parametrize(("outside", "sign"), [(1.7, 1), (-0.4, -1)])
    def test_colours_out_of_range_feel_the_way_back(self, space, outside, sign):
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

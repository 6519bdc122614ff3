"""Codes of light above 1."""

import numpy as np
import pytest

from eigengs_dr.image.color import from_log, to_coded, to_log, to_picture, to_pu21
from eigengs_dr.image.metrics import psnr

LIGHT = np.array([-0.005, 0, 1e-4, 0.01, 0.18, 1, 12, 5e3, 1e6])


def test_logarithms_come_back():
    np.testing.assert_allclose(from_log(to_log(LIGHT))[1:], LIGHT[1:], rtol=1e-12, atol=1e-15)
    assert to_log(LIGHT)[5] == pytest.approx(1)
    assert (np.diff(to_log(LIGHT)) > 0).all()
    assert from_log(np.float32([-50])) > -0.0101  # light below 0 is bounded
    assert to_log(LIGHT.astype(np.float32)).dtype == np.float32


def test_logarithms_in_dr_jit():
    from drjit.llvm.ad import Float

    codes = to_log(LIGHT[1:-1])
    np.testing.assert_allclose(from_log(Float(codes)).numpy(), LIGHT[1:-1], rtol=1e-5, atol=1e-8)


def test_pu21_of_known_luminances():
    """Values of the authors' program, for 0.005, 100 and 10,000 cd/m^2, divided by that of 100."""
    codes = to_pu21(np.array([5e-5, 1, 100.0]))
    np.testing.assert_allclose(256.38 * codes, [0, 256.38, 595.39], atol=0.1)
    np.testing.assert_array_equal(to_pu21(np.array([-1, 0, 1e9])), codes[[0, 0, 2]])


def test_psnr_in_pu21():
    light = np.full((4, 5, 3), 8.0)
    brighter = light * 1.1
    assert psnr(to_coded(light), to_coded(brighter), space="rgb") == np.inf  # both are white
    found = psnr(to_coded(light), to_coded(brighter), space="pu21")
    expected = -20 * np.log10(to_pu21(brighter) - to_pu21(light))[0, 0, 0]
    assert found == pytest.approx(expected)


@pytest.mark.parametrize("space", ["linear", "radiance", "log"])
def test_pictures_are_coded(space):
    np.testing.assert_array_equal(to_picture(space, LIGHT), to_coded(np.maximum(LIGHT, 0)))
    assert to_picture("rgb", LIGHT) is LIGHT

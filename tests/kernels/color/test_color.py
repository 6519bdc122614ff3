"""Codes and light: the same formula on NumPy and Dr.Jit arrays."""

import drjit as dr
import numpy as np
import pytest

from eigengs_dr.backend.selection import select
from eigengs_dr.image.color import from_log, to_coded, to_linear, to_log

# --- sRGB and linear light ---------------------------------------------------------------------


def test_srgb_of_the_standard():
    """Ends, the grey of half the light, and the powers themselves."""
    np.testing.assert_allclose(to_linear(np.array([0.0, 0.04045, 1.0])), [0, 0.04045 / 12.92, 1])
    assert to_coded(0.5) == pytest.approx(0.735357, abs=1e-6)
    assert to_linear(188 / 255) == pytest.approx(0.50289, abs=1e-5)
    codes = np.linspace(0.05, 1.5, 30)
    np.testing.assert_allclose(to_linear(codes), ((codes + 0.055) / 1.055) ** 2.4, rtol=1e-14)
    np.testing.assert_allclose(to_linear(-codes), -codes / 12.92, rtol=1e-14)
    np.testing.assert_allclose(to_coded(to_linear(codes)), codes, rtol=1e-12)


@pytest.mark.parametrize(
    ("convert", "slopes"),
    [(to_linear, [1 / 12.92] * 3 + [2.4 / 1.055]), (to_coded, [12.92] * 3 + [1.055 / 2.4])],
)
def test_slopes_of_srgb_are_finite_everywhere(backend, convert, slopes):
    """Also where the power of the other part has none: at -0.055, at 0 and below."""
    Float = select(backend).Float64
    for mode in ("backward", "forward"):
        x = Float(-0.055, -1, 0, 1)
        dr.enable_grad(x)
        y = convert(x)
        if mode == "backward":
            dr.backward(y)
            found = dr.grad(x)
        else:
            dr.forward(x)
            found = dr.grad(y)
        np.testing.assert_allclose(found.numpy(), slopes, rtol=1e-12)


# --- Light above 1 ---------------------------------------------------------------------------


LIGHT = np.array([-0.005, 0, 1e-4, 0.01, 0.18, 1, 12, 5e3, 1e6])


def test_logarithms_come_back(backend):
    np.testing.assert_allclose(from_log(to_log(LIGHT))[1:], LIGHT[1:], rtol=1e-12, atol=1e-15)
    codes = select(backend).Float(to_log(LIGHT[1:-1]))
    np.testing.assert_allclose(from_log(codes).numpy(), LIGHT[1:-1], rtol=1e-5, atol=1e-8)
    assert to_log(LIGHT)[5] == pytest.approx(1)
    assert (np.diff(to_log(LIGHT)) > 0).all()
    assert from_log(np.float32([-50])) > -0.0101  # light below 0 is bounded
    assert to_log(LIGHT.astype(np.float32)).dtype == np.float32

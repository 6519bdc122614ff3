"""Spectra of colours: their basis, colours back through Mitsuba's curves, derivatives."""

import drjit as dr
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")

from _helpers.variants import in_variants, on_both, variant  # noqa: E402, F401
from eigengs_dr.plugins import color as spectrum  # noqa: E402

pytestmark = [
    pytest.mark.mitsuba,
    pytest.mark.usefixtures("variant"),
    in_variants(on_both("spectral")),
]


def evaluate(colors, wavelengths):
    """Spectra of colours of shape (3, n) at wavelengths of shape (m,): shape (n, m)."""
    count, samples = colors.shape[1], len(wavelengths)
    rgb = mi.Color3f(np.repeat(colors, samples, axis=1).astype(np.float32))
    at = mi.Spectrum(mi.Float(np.tile(wavelengths, count).astype(np.float32)))
    result = np.array(spectrum.upsample(rgb, at, spectrum.upload_table()))
    assert np.all(result == result[:1])  # all four components are alike
    return result[0].reshape(count, samples)


def to_srgb(spectra, wavelengths):
    """Colour under D65 of spectra of shape (n, m), by Mitsuba's curves: shape (3, n)."""
    count = len(wavelengths)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wavelengths = mi.Spectrum(mi.Float(wavelengths.astype(np.float32)))
    light = np.array(mi.load_dict({"type": "d65"}).eval(si))[0].astype(np.float64)
    curves = np.array(mi.cie1931_xyz(mi.Float(wavelengths.astype(np.float32))))
    xyz = (curves[:, None] * (spectra * light)).sum(axis=-1)  # next to nothing at the ends
    xyz *= (wavelengths[1] - wavelengths[0]) * mi.MI_CIE_Y_NORMALIZATION
    return np.array(mi.xyz_to_srgb(mi.Color3f(xyz.astype(np.float32))))


FINE = np.arange(360, 831.0)
"""Every nanometre: between the samples of the basis too."""


def test_basis_is_a_smooth_partition_of_unity():
    wavelengths, spectra = spectrum.basis()
    assert wavelengths[0] == mi.MI_CIE_MIN and wavelengths[-1] == mi.MI_CIE_MAX
    assert spectra.shape == (3, len(wavelengths))
    assert spectra.min() >= 0
    np.testing.assert_allclose(spectra.sum(axis=0), 1, rtol=0, atol=1e-15)
    # From 0 to 1 a spectrum takes some 50 nm: no combs, which would round-trip as well.
    assert np.abs(np.diff(spectra, axis=1)).max() < 0.15
    assert np.abs(np.diff(spectra, axis=1)).sum(axis=1).max() < 2.2


def test_round_trip():
    """Of primaries, secondaries, and others; greys are exact."""
    random = np.random.default_rng(0).uniform(size=(3, 50))
    colors = np.concatenate([np.eye(3), 1 - np.eye(3), random], axis=1)
    back = to_srgb(evaluate(colors, FINE), FINE)
    np.testing.assert_allclose(back, colors, rtol=0, atol=3e-4)
    grey = np.linspace(0, 1, 56, dtype=np.float32)
    assert np.all(evaluate(np.broadcast_to(grey, (3, 56)), FINE) == grey[:, None])


def test_wavelengths_that_are_none():
    odd = np.array([np.nan, 0, -1, 359.9, 830.1, 1e9, np.inf, -np.inf])
    assert np.all(evaluate(np.full((3, 1), 0.5), odd) == 0)
    assert np.all(evaluate(np.full((3, 1), 0.5), np.array([360.0, 830.0])) == 0.5)


COLOR = (0.2, 0.7, 0.4)
AT = (431.0, 502.5, 583.0, np.nan)


def colored():
    """One colour that has a gradient, and its spectrum at one set of four wavelengths."""
    rgb = mi.Color3f(*COLOR)
    dr.enable_grad(rgb)
    at = mi.Spectrum(*AT)
    return rgb, spectrum.upsample(rgb, at, spectrum.upload_table())


def test_derivatives_in_both_modes_are_the_basis():
    basis = evaluate(np.eye(3), np.array(AT))  # of a linear function: finite differences
    for k in range(3):
        rgb, value = colored()
        rgb[k].grad = 1
        dr.forward_to(value)
        np.testing.assert_allclose(np.array(value.grad)[:, 0], basis[k], rtol=0, atol=1e-6)
    weight = (1.0, -2.0, 3.0, 5.0)
    rgb, value = colored()
    value.grad = mi.Spectrum(*weight)
    dr.backward_to(rgb)
    np.testing.assert_allclose(np.array(rgb.grad)[:, 0], basis @ weight, rtol=0, atol=1e-5)

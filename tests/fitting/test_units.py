"""Data in any unit: fits, their PSNRs and searches do not depend on scale and offset."""

import numpy as np
import pytest

import eigengs_dr as eg
from eigengs_dr.fitting.objective import Channels, Target
from eigengs_dr.fitting.options import FitOptions
from eigengs_dr.fitting.problem import Problem
from eigengs_dr.image.space import DATA, RGB, Affine, Extent

SIDE = 40


@pytest.fixture(scope="module")
def values():
    """Heights from 0 to 1, which are no codes of 8 bits."""
    y, x = np.indices((SIDE, SIDE)) / SIDE
    found = np.sin(7 * x + 2 * y) * np.cos(9 * y * x) + 0.3 * (np.hypot(x - 0.6, y - 0.4) < 0.2)
    return ((found - found.min()) / np.ptp(found)).astype(np.float64)


def fit(values, **options):
    return eg.fit(values, **{"gaussians": 60, "iterations": 60, "space": "data", **options})


def psnr_of_range(found, values):
    """The PSNR with the range as the peak, by NumPy in float64."""
    error = np.square(found.image[..., 0].astype(float) - values).mean()
    return 10 * np.log10(np.ptp(values) ** 2 / error)


@pytest.fixture(scope="module")
def plain(values):
    return fit(values)


UNITS = [
    (1e-6, 0),
    (1e-6, 1e-2),
    (0.01, -3),
    (3, 1),
    (300, 1200),
    (1e6, 0),
    (0.01, -100),
    (1e4, 1e8),
]


@pytest.mark.parametrize(("scale", "offset"), UNITS)
def test_psnrs_do_not_depend_on_the_unit(values, plain, scale, offset):
    """Offsets up to 10,000 ranges, of which float32 leaves the range three digits."""
    other = scale * values + offset
    found = fit(other)
    rounded = values
    if abs(offset) > 100 * scale:
        rounded = (np.float64(np.float32(other)) - offset) / scale
        plain = fit(rounded)
    assert psnr_of_range(plain, rounded) == pytest.approx(plain.psnr_ycbcr, abs=0.01)
    assert found.psnr_ycbcr == pytest.approx(plain.psnr_ycbcr, abs=0.2)
    if abs(offset) < 100 * scale:  # else the result is rounded as the data are
        assert psnr_of_range(found, other) == pytest.approx(found.psnr_ycbcr, abs=0.05)


def test_goals_do_not_depend_on_the_unit(values):
    """Rounding decides about some Gaussians of a short search."""
    counts = []
    for scale, offset in ((1, 0), (1e-6, 0), (300, 1200)):
        data = scale * values + offset
        found = fit(data, gaussians=None, target_psnr=40, iterations=150)
        assert found.stopped == "met"
        assert psnr_of_range(found, data) >= 39.99
        counts.append(len(found.gaussians))
    assert max(counts) < 1.35 * min(counts)


def test_data_without_codes_have_no_psnr_rgb(values):
    """Codes run from 0 to 1; other data have none."""
    assert np.isfinite(fit(values, iterations=0).psnr_rgb)
    for data in (300 * values, values - 0.1, 0.05 * values):
        found = fit(data, iterations=0)
        assert np.isnan(found.psnr_rgb) and np.isfinite(found.psnr_ycbcr)
        assert all(np.isnan(row["psnr_rgb"]) for row in found.trace)


@pytest.mark.parametrize("value", [0.0, 0.3, -7.0, 1e-6, 1e6])
def test_constant_data_are_exact(value):
    """Except for rounding; their range is none, and rounding makes none."""
    found = fit(np.full((SIDE, SIDE), value), iterations=20)
    np.testing.assert_allclose(found.image, value, rtol=1e-6)
    assert found.psnr_ycbcr > 100


@pytest.mark.parametrize("channels", [1, 3])
def test_the_unit_of_data(channels):
    """Mean 0 and range 1, and back."""
    pixels = np.random.default_rng(0).uniform(-3, 5, (9, 8, channels)).astype(np.float32)
    target = Target.of(pixels, DATA)
    assert target.values.mean() == pytest.approx(0, abs=1e-6)
    assert np.ptp(target.values) == pytest.approx(1)
    shown = target.values * target.unit.scale + target.unit.offset
    np.testing.assert_allclose(shown, pixels, atol=1e-5)
    extent = Extent.of(pixels[:4]).joined(Extent.of(pixels[4:]))
    np.testing.assert_allclose(DATA.unit(extent), target.unit, rtol=1e-6)
    assert Target.of(pixels, RGB).unit == Affine()


@pytest.mark.parametrize("space", ["linear", "log"])
def test_light_of_any_scale(values, space):
    """Far from what a display shows, PSNRs do not depend on the scale; sets do."""
    light = np.repeat((0.01 + values**4)[..., None], 3, axis=2)
    light[3, 3] = 5  # above 1 at every scale, so that the space is the same
    found = []
    for scale in (1e3, 1e5):
        options = {"space": space, "encoding": "linear", "iterations": 60}
        found.append(eg.fit(scale * light, 60, **options))
        rendered = eg.render(found[-1].gaussians).numpy()
        np.testing.assert_allclose(rendered.mean(), scale * light.mean(), rtol=0.2)
    assert found[1].psnr_ycbcr == pytest.approx(found[0].psnr_ycbcr, abs=0.2)


def test_sets_there_and_back():
    gaussians = eg.fit(np.eye(8), 5, 0, space="data").gaussians
    target = Target(np.zeros((8, 8, 1)), np.zeros((8, 8, 1)), Affine(30.0, -7.0))
    channels = Channels("", DATA, slice(0, 1), (target,))
    problem = Problem((channels,), (8, 8), FitOptions())
    back = problem.restored(problem.fitted(gaussians)).to_arrays()
    for name, expected in gaussians.to_arrays().items():
        np.testing.assert_allclose(back[name], expected, atol=1e-5)

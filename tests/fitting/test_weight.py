"""Weights of pixels and of their channels in whole fits."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.photos import coffee
from eigengs_dr.fitting.problem import pixels_in
from eigengs_dr.image.pixels import check_weight
from eigengs_dr.image.space import DATA, to_planes

SIDE = 48
QUICK = {"gaussians": 80, "iterations": 110}


@pytest.fixture(scope="module")
def image():
    return coffee(SIDE)


@pytest.fixture(scope="module")
def disc():
    """1 in a disc, less at its edge, and 0 outside."""
    y, x = np.indices((SIDE, SIDE)) + 0.5
    return np.clip(18 - np.hypot(x - 24, y - 24), 0, 1).astype(np.float32)


def weighted_psnr(image, rendered, weight, space):
    """The PSNR of squared errors with weights (H, W), by NumPy; rgb is that of 8 bits."""
    pictures = image, rendered
    if space == "rgb":
        pictures = [np.rint(np.clip(p, 0, 1) * 255) / 255 for p in pictures]
    a, b = (to_planes(p.astype(np.float32), space).astype(float) for p in pictures)
    squares = np.square(a - b).mean(axis=0)
    return -10 * np.log10(np.average(squares, weights=weight.ravel()))


@pytest.mark.parametrize("layers", [0, 1, 3])
@pytest.mark.parametrize("space", ["ycbcr", "rgb", "linear", "data"])
def test_psnrs_are_weighted(image, disc, space, layers):
    weight = disc
    if layers:
        weight = disc[..., None] * np.array([1, 2, 0])[:layers]
    found = eg.fit(image, 80, 30, space=space, weight=5 * weight)
    mean = weight if weight.ndim == 2 else weight.mean(axis=2)
    first = "rgb" if space == "data" else "ycbcr"
    best = max(found.trace, key=lambda row: row["psnr_ycbcr"])
    assert (found.psnr_ycbcr, found.psnr_rgb) == (best["psnr_ycbcr"], best["psnr_rgb"])
    expected = weighted_psnr(image, found.image, mean, "rgb")
    assert found.psnr_rgb == pytest.approx(expected, abs=2e-3)
    if first == "ycbcr":
        expected = weighted_psnr(image, found.image, mean, "ycbcr")
        assert found.psnr_ycbcr == pytest.approx(expected, abs=1e-3)
    assert found.psnr_ycbcr > found.trace[0]["psnr_ycbcr"]


@pytest.mark.parametrize("space", ["ycbcr", "linear"])
def test_gaussians_go_where_the_weight_is(image, disc, space):
    """The disc gains over a fit of the whole image."""
    plain, found = (eg.fit(image, space=space, weight=w, **QUICK) for w in (None, disc))
    gain = [weighted_psnr(image, r.image, disc, "ycbcr") for r in (plain, found)]
    assert gain[1] > gain[0] + 0.7


def test_pixels_without_weight_may_be_anything(image, disc):
    """NaN, infinite, out of range: they are never looked at."""
    found = []
    for value in (np.nan, np.inf, -7.0):
        hidden = image.copy()
        hidden[disc == 0] = value
        found.append(eg.fit(hidden, weight=disc, **QUICK))
    for other in found[1:]:
        np.testing.assert_array_equal(other.image, found[0].image)
    assert np.isnan(hidden).sum() == 0  # the image of the caller stays as it is
    assert weighted_psnr(image, found[0].image, disc, "ycbcr") > 30


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_only_ratios_of_weights_count(image, disc, factor):
    one, other = (eg.fit(image, weight=f * disc, **QUICK) for f in (1, factor))
    assert other.psnr_ycbcr == pytest.approx(one.psnr_ycbcr, abs=0.2)


def test_equal_weights_are_none(image):
    plain = eg.fit(image, 80, 30)
    for weight in (np.ones((SIDE, SIDE)), np.full((SIDE, SIDE, 3), 7), np.ones((SIDE, SIDE), bool)):
        found = eg.fit(image, 80, 30, weight=weight)
        assert found.psnr_ycbcr == pytest.approx(plain.psnr_ycbcr, abs=0.02)


def test_a_channel_may_weigh_nothing(image):
    """Of data: the others are better for it."""
    weight = np.zeros((SIDE, SIDE, 3))
    weight[..., 0] = 1
    found, plain = (eg.fit(image, space="data", weight=w, **QUICK).image for w in (weight, None))
    one, other = (eg.psnr(f[..., :1], image[..., :1]) for f in (found, plain))
    assert one > other + 0.3
    assert np.isfinite(found).all()


def test_a_goal_with_weights_takes_fewer(image, disc):
    few, many = (eg.fit(image, iterations=150, target_psnr=36, weight=w) for w in (disc, None))
    assert (few.stopped, many.stopped) == ("met", "met")
    assert len(few.gaussians) < 0.8 * len(many.gaussians)
    assert weighted_psnr(image, few.image, disc, "rgb") > 35.99


def test_data_without_weight_do_not_set_the_range():
    """Nor whether data are codes."""
    y, x = np.indices((SIDE, SIDE)) / SIDE
    heights, weight = 3 + np.sin(9 * x) * y, np.ones((SIDE, SIDE))
    weight[:5] = 0
    plain = heights.copy()
    plain[:5] = plain[5]
    heights[:5] = 1e6
    found, expected = (eg.fit(v, 60, 20, space="data", weight=weight) for v in (heights, plain))
    assert found.psnr_ycbcr == pytest.approx(expected.psnr_ycbcr, abs=0.05)
    np.testing.assert_allclose(found.image[5:], heights[5:, :, None], atol=0.3)


@pytest.mark.parametrize(
    ("weight", "words"),
    [
        (np.zeros((SIDE, SIDE)), "weight is 0 for all pixels; at least one must count"),
        (-np.eye(SIDE), "finite and at least 0"),
        (np.full((SIDE, SIDE), np.nan), "finite and at least 0"),
        (np.full((SIDE, SIDE), np.inf), "finite and at least 0"),
        (np.ma.masked_less(np.eye(SIDE), 1), "weight holds masked values; expected real"),
        (np.ones(SIDE), r"weight has shape \(48,\); expected \(H, W\)"),
        ("x", "weight holds <U1; expected real numbers"),
        (np.eye(SIDE) * 1j, "weight holds complex128; expected real numbers"),
        ([[1, 2], [3]], "weight: not an array"),
        (1.0, r"weight has shape \(\); expected"),
        (np.ones((0, 4)), "weight has shape"),
        (np.ones((SIDE, SIDE + 1)), "weight is for 49x48 pixels, but the image has shape"),
        (np.ones((SIDE, SIDE, 2)), "weight has 2 channels, but the fit has 3"),
    ],
)
def test_weights_that_are_refused(image, weight, words):
    with pytest.raises(ValueError, match=words) as error:
        eg.fit(image, 9, 0, weight=weight)
    assert "\n" not in str(error.value)


def test_what_counts_must_be_finite(image, disc):
    """A pixel of little weight is a pixel."""
    hidden = image.copy()
    hidden[24, 24] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        eg.fit(hidden, 9, 0, weight=disc)


def test_weights_have_the_mean_1():
    weight = np.random.default_rng(0).uniform(0, 9, (5, 7))
    np.testing.assert_allclose(check_weight(weight), weight / weight.mean(), rtol=1e-6)
    assert check_weight(None) is None


def test_pixels_without_weight_get_the_nearest_value():
    row = np.array([[1.0, np.nan, np.nan, np.nan, 2.0]])
    pixels, _ = pixels_in(row, DATA, np.array([[1, 0, 0, 0, 1.0]]))
    assert pixels.ravel().tolist() in ([1, 1, 1, 2, 2], [1, 1, 2, 2, 2])

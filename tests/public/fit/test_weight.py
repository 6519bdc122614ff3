"""Weights of pixels and of their channels."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.photos import coffee

SIDE = 32
IMAGE = coffee(SIDE)
QUICK = {"gaussians": 60, "iterations": 110}


def disc():
    """1 in a disc, less at its edge, and 0 outside."""
    y, x = np.indices((SIDE, SIDE)) + 0.5
    return np.clip(12 - np.hypot(x - 16, y - 16), 0, 1).astype(np.float32)


@pytest.mark.parametrize("layers", [0, pytest.param(1, marks=pytest.mark.slow), 3])
@pytest.mark.parametrize("space", ["ycbcr", "rgb", "linear", "data"])
def test_psnrs_are_weighted(space, layers):
    """Weights of channels count by their mean; those of the caller have any scale."""
    weight = disc()
    if layers:
        weight = weight[..., None] * np.array([1, 2, 0])[:layers]
    found = eg.fit(IMAGE, 60, 30, space=space, weight=5 * weight)
    best = max(found.trace, key=lambda row: row["psnr_ycbcr"])
    assert (found.psnr_ycbcr, found.psnr_rgb) == (best["psnr_ycbcr"], best["psnr_rgb"])
    assert found.psnr_ycbcr > found.trace[0]["psnr_ycbcr"]
    assert found.psnr_rgb == pytest.approx(eg.psnr(IMAGE, found.image, "rgb", disc()), abs=2e-3)
    if space != "data":
        expected = eg.psnr(IMAGE, found.image, "ycbcr", disc())
        assert found.psnr_ycbcr == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("space", ["ycbcr", pytest.param("linear", marks=pytest.mark.slow)])
def test_gaussians_go_where_the_weight_is(space):
    """The disc gains over a fit of the whole image."""
    plain, found = (eg.fit(IMAGE, space=space, weight=w, **QUICK) for w in (None, disc()))
    gain = [eg.psnr(IMAGE, r.image, "ycbcr", disc()) for r in (plain, found)]
    assert gain[1] > gain[0] + 0.7


def test_pixels_without_weight_may_be_anything():
    """NaN, infinite, out of range: they are never looked at."""
    found = []
    for value in (np.nan, np.inf, -7.0):
        hidden = IMAGE.copy()
        hidden[disc() == 0] = value
        found.append(eg.fit(hidden, weight=disc(), **QUICK))
    for other in found[1:]:
        np.testing.assert_array_equal(other.image, found[0].image)
    assert (hidden == -7).any()  # the image of the caller stays as it is
    assert eg.psnr(IMAGE, found[0].image, "ycbcr", disc()) > 30
    hidden[16, 16] = np.nan  # a pixel of little weight is a pixel
    with pytest.raises(ValueError, match="not finite"):
        eg.fit(hidden, 9, 0, weight=disc())


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_only_ratios_of_weights_count(factor):
    one, other = (eg.fit(IMAGE, weight=f * disc(), **QUICK) for f in (1, factor))
    assert other.psnr_ycbcr == pytest.approx(one.psnr_ycbcr, abs=0.2)


def test_equal_weights_are_none():
    plain = eg.fit(IMAGE, 60, 30)
    for weight in (np.ones((SIDE, SIDE)), np.full((SIDE, SIDE, 3), 7), np.ones((SIDE, SIDE), bool)):
        found = eg.fit(IMAGE, 60, 30, weight=weight)
        assert found.psnr_ycbcr == pytest.approx(plain.psnr_ycbcr, abs=0.02)


def test_a_channel_may_weigh_nothing():
    """Of data: the others are better for it."""
    weight = np.zeros((SIDE, SIDE, 3))
    weight[..., 0] = 1
    found, plain = (eg.fit(IMAGE, space="data", weight=w, **QUICK).image for w in (weight, None))
    one, other = (eg.psnr(f[..., :1], IMAGE[..., :1]) for f in (found, plain))
    assert one > other + 0.3
    assert np.isfinite(found).all()


def test_a_goal_with_weights_takes_fewer():
    few, many = (eg.fit(IMAGE, iterations=100, target_psnr=44, weight=w) for w in (disc(), None))
    assert (few.stopped, many.stopped) == ("met", "met")
    assert len(few.gaussians) < 0.8 * len(many.gaussians)
    assert eg.psnr(IMAGE, few.image, "rgb", disc()) > 43.99


def test_levels_with_weights():
    """Relocation leaves what has no weight."""
    image = coffee(48)
    weight, hidden = np.ones(image.shape[:2], np.float32), image.copy()
    weight[:, 24:], hidden[:, 24:] = 0, np.nan
    found, left = (
        eg.fit(hidden, [40, 120], iterations=200, weight=weight, method=method).gaussians
        for method in (eg.DEFAULT, eg.DEFAULT.without("grows", "moves"))
    )
    for count in (40, 120):
        one, other = (eg.picture_of(g[:count])[:, :24] for g in (found, left))
        assert eg.psnr(one, image[:, :24]) > eg.psnr(other, image[:, :24]) + 0.5


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
        (np.ma.masked_less(np.eye(SIDE), 1), "weight holds masked values; expected real"),
        ("x", "weight holds <U1; expected real numbers"),
        ([[1, 2], [3]], "weight: not an array"),
        (np.ones((SIDE, SIDE + 1)), "weight is for 33x32 pixels, but the image has shape"),
        (np.ones((SIDE, SIDE, 2)), "weight has 2 channels, but the fit has 3"),
    ],
)
def test_weights_that_are_refused(weight, words):
    with pytest.raises(ValueError, match=words) as error:
        eg.fit(IMAGE, 9, 0, weight=weight)
    assert "\n" not in str(error.value)

"""Levels of detail: prefixes of a set that form the image too."""

from itertools import pairwise

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.photos import coffee
from _helpers.waves import METHODS

IMAGE = coffee(32)
COUNTS = [16, 64]


@pytest.fixture(scope="module")
def result():
    return eg.fit(IMAGE, COUNTS, iterations=100)


def reached(gaussians, image=IMAGE):
    return eg.psnr(eg.picture_of(gaussians), image, "ycbcr")


@pytest.mark.parametrize(
    ("count", "levels", "message"),
    [
        (9, [5, 5, 9], r"levels is \[5, 5, 9\]; its numbers must rise"),
        (9, [4.5, 9], r"levels is \[4.5, 9\]; it must be a list of whole numbers"),
        (9, [5, 8], r"levels is \[5, 8\]; the last must be the number of Gaussians, 9"),
        (3, 2, "levels is 2; 3 Gaussians make 1 to 1"),
        (9, 10**9, "levels is 1000000000; 9 Gaussians make 1 to"),
    ],
)
def test_counts_that_are_refused(count, levels, message):
    kind = TypeError if "whole numbers" in message else ValueError
    with pytest.raises(kind, match=message) as caught:
        eg.level_counts(count, levels)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gaussians": [True, 9]}, r"gaussians is \[True, 9\]; it must be a list of whole numbers"),
        ({"gaussians": np.array([4.5, 9])}, r"array\(.*; it must be a list of whole numbers"),
        ({"method": METHODS["gaussianimage"]}, "levels need the placement Adaptive"),
        ({"start": "a.npz"}, "levels and start exclude each other"),
    ],
)
def test_fits_that_are_refused(options, message):
    kind = TypeError if "whole numbers" in message else ValueError
    with pytest.raises(kind, match=message) as caught:
        eg.fit(IMAGE, **{"gaussians": [5, 9], **options})
    assert "\n" not in str(caught.value)


def test_ways_to_ask_for_levels():
    first, *others = (
        eg.fit(IMAGE, counts, 0, **options)
        for counts, options in ((COUNTS, {}), (np.array(COUNTS), {}), (64, {"levels": 2}))
    )
    for other in others:
        np.testing.assert_array_equal(other.image, first.image)


def test_every_level_gains_by_relocation():
    """Of few Gaussians, whose first places are poor: each level gains a decibel here."""
    image, counts = eg.sample("coffee")[200:264, 300:364], [100, 140, 180]
    found, left = (
        eg.fit(image, counts, iterations=300, method=method).gaussians
        for method in (eg.DEFAULT, eg.DEFAULT.without("densify", "relocate"))
    )
    for count in counts:
        assert reached(found[:count], image) > reached(left[:count], image) + 0.3


def test_every_prefix_forms_the_image(result):
    """The more, the better; the picture of the result is that of the whole set."""
    prefixes = [result.gaussians[:n] for n in (*COUNTS[:1], 28, 40, 52)] + [result.gaussians]
    psnrs = [reached(g) for g in prefixes]
    assert all(one < other for one, other in pairwise(psnrs)) and psnrs[0] > 22
    np.testing.assert_array_equal(result.image, eg.picture_of(result.gaussians))
    assert psnrs[-1] == pytest.approx(max(row["psnr_ycbcr"] for row in result.trace), abs=1e-3)


def test_a_level_is_sorted_by_worth():
    """By the squared error that the picture of the level gains without a Gaussian."""
    gaussians = eg.fit(IMAGE, COUNTS, iterations=20, space="rgb").gaussians
    for low, high in pairwise([0, *COUNTS]):
        level = gaussians[:high]
        sets = [level[np.arange(high) != n] for n in range(low, high)]
        errors = [np.square(eg.render(g).numpy() - IMAGE).sum(dtype=float) for g in sets]
        assert (np.diff(errors) <= 1e-3 * np.ptp(errors)).all()


@pytest.mark.parametrize("space", [pytest.param("linear", marks=pytest.mark.slow), "data"])
def test_other_spaces(space):
    found = eg.fit(IMAGE, COUNTS, iterations=5, space=space)
    assert found.gaussians.space == space
    assert eg.psnr(eg.picture_of(found.gaussians[:16]), IMAGE) > 18


def test_levels_share_the_background():
    """What is added later does not change the levels before."""
    found = eg.fit(IMAGE, COUNTS, iterations=0).gaussians
    alone = eg.fit(IMAGE, COUNTS[0], iterations=0).gaussians
    background = alone.to_arrays()["background"]
    np.testing.assert_allclose(found.to_arrays()["background"], background, atol=1e-6)

"""Levels of detail: prefixes of a set that make the image too."""

from itertools import pairwise

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.halves import objective_of
from _helpers.packed import few_groups
from _helpers.photos import coffee
from _helpers.waves import METHODS
from eigengs_dr.codec.packing import MSE_WITHOUT_IMAGE
from eigengs_dr.fitting.control import removal_cost
from eigengs_dr.fitting.fit import fit
from eigengs_dr.fitting.options import level_counts
from eigengs_dr.image.color import rgb_to_ycbcr
from eigengs_dr.raster.render import picture_of


@pytest.fixture(scope="module")
def image():
    return coffee(48)


@pytest.fixture(scope="module")
def result(image):
    return fit(image, level_counts(256, 3), iterations=150)


def reached(gaussians, image):
    return eg.psnr(picture_of(gaussians), image, space="ycbcr")


@pytest.mark.parametrize(
    ("count", "levels", "message"),
    [
        (9, [5, 5, 9], "levels 5, 5, 9: numbers of Gaussians must rise"),
        (9, [0, 9], "must rise, from 1 or more"),
        (9, [], "must rise, from 1 or more"),
        (9, [4.5, 9], "levels 4.5, 9: numbers of Gaussians must be whole"),
        (9, [5, 8], "levels 5, 8: the last must be the number of Gaussians, 9"),
        (3, 2, "levels is 2; 3 Gaussians make 1 to 1"),
        (5, 0, "levels is 0; 5 Gaussians make 1 to"),
        (9, 10**9, "levels is 1000000000; 9 Gaussians make 1 to"),
    ],
)
def test_bad_levels_are_refused(count, levels, message):
    with pytest.raises(ValueError, match=message) as caught:
        level_counts(count, levels)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gaussians": [5, 5, 9]}, "levels 5, 5, 9: numbers of Gaussians must rise"),
        ({"gaussians": [0, 9]}, "must rise, from 1 or more"),
        ({"gaussians": []}, "must rise, from 1 or more"),
        ({"gaussians": [True, 9]}, "levels True, 9: numbers of Gaussians must be whole"),
        ({"gaussians": np.array([4.5, 9])}, "levels 4.5, 9.0: numbers of Gaussians must be whole"),
        ({"gaussians": [9, 48 * 48 + 1]}, "gaussians is 2305; an image of 48x48 takes 1 to 2304"),
        ({"target_psnr": 30}, "gaussians and target_psnr exclude each other"),
        ({"method": METHODS["gaussianimage"]}, "levels need the placement Adaptive and no start"),
        ({"start": "a.npz"}, "levels need the placement Adaptive and no start"),
    ],
)
def test_levels_that_cannot_be_fitted_are_refused(image, options, message):
    with pytest.raises(ValueError, match=message) as caught:
        fit(image, **{"gaussians": [5, 9], **options})
    assert "\n" not in str(caught.value)


def test_numbers_of_another_type_are_refused(image):
    with pytest.raises(TypeError, match="gaussians is b'5'; it must be a whole number"):
        fit(image, b"5")


def test_counts_may_be_those_of_numpy(image):
    one, two = (fit(image, counts, 0) for counts in ([9, 30], np.array([9, 30])))
    np.testing.assert_array_equal(one.image, two.image)


def test_every_level_gains_by_relocation():
    """Of few Gaussians, whose first places are poor: each level gains a decibel here."""
    image, counts = eg.sample("coffee")[200:264, 300:364], [100, 140, 180]
    found, left = (
        fit(image, counts, iterations=300, method=method).gaussians
        for method in (eg.DEFAULT, eg.DEFAULT.without("grows", "moves"))
    )
    for count in counts:
        assert reached(found[:count], image) > reached(left[:count], image) + 0.3


def test_any_number_between_is_better_than_the_level_before(image, result):
    counts = level_counts(256, 3)
    for low, high in pairwise(counts):
        part = reached(result.gaussians[: (low + high) // 2], image)
        assert reached(result.gaussians[:low], image) < part


def test_a_level_is_sorted_by_worth(image, result):
    objective, before = objective_of(image), 0
    for count in level_counts(256, 3):
        value = removal_cost(result.gaussians[:count], objective)[before:]
        assert (np.diff(value) <= 1e-4 * value.max()).all()
        before = count


def test_the_picture_is_that_of_the_whole_set(image, result):
    np.testing.assert_array_equal(result.image, picture_of(result.gaussians))
    best = max(row["psnr_ycbcr"] for row in result.trace)
    assert reached(result.gaussians, image) == pytest.approx(best, abs=1e-3)


@pytest.mark.parametrize("color", ["linear", "rgb", "data"])
def test_other_colours(image, color):
    found = fit(image, [16, 64], iterations=5, space=color)
    assert found.gaussians.space == color
    assert np.isfinite(picture_of(found.gaussians[:16])).all()


@few_groups()
def test_packed_levels_are_read_one_by_one(image, result, tmp_path):
    counts = level_counts(256, 3)
    sections = np.diff(counts, prepend=0).tolist()
    receipt = eg.pack(result.gaussians, tmp_path / "a.egs", image, 1.0, sections)
    for k, count in enumerate(counts, 1):
        part = eg.Gaussians.load(tmp_path / "a.egs", sections=k)
        assert len(part) == count
        lost = reached(result.gaussians[:count], image) - reached(part, image)
        assert lost <= 1.0 + 1e-3
    assert receipt.psnr_drop == pytest.approx(lost, abs=1e-3)
    assert receipt.psnr_drop > 0.3
    plain = eg.pack(result.gaussians, tmp_path / "b.egs", image, 1.0)
    assert plain.bytes < receipt.bytes < 1.5 * plain.bytes


def test_packed_levels_without_an_image_keep_what_they_have_of_the_whole(result, tmp_path):
    counts = level_counts(256, 3)
    eg.pack(result.gaussians, tmp_path / "a.egs", None, 0.5, np.diff(counts, prepend=0).tolist())
    whole = rgb_to_ycbcr(picture_of(result.gaussians))

    def error(part):
        return np.square(rgb_to_ycbcr(picture_of(part)) - whole).mean() + MSE_WITHOUT_IMAGE

    for k, count in enumerate(counts, 1):
        part = eg.Gaussians.load(tmp_path / "a.egs", sections=k)
        assert error(part) <= 1.001 * 10**0.05 * error(result.gaussians[:count])


def test_levels_keep_the_background(image):
    """What is added later does not change the levels before: one background serves all."""
    found = fit(image, [16, 64], iterations=0).gaussians
    alone = eg.DEFAULT.place_and_solve(objective_of(image), 16)
    np.testing.assert_allclose(
        found.to_arrays()["background"], alone.to_arrays()["background"], atol=1e-6
    )


def test_levels_with_weights(image):
    """Pixels without weight do not count, whatever they are; relocation leaves them."""
    weight, hidden = np.ones(image.shape[:2], np.float32), image.copy()
    weight[:, 24:], hidden[:, 24:] = 0, np.nan
    found, left = (
        fit(hidden, [40, 120], iterations=200, weight=weight, method=method).gaussians
        for method in (eg.DEFAULT, eg.DEFAULT.without("grows", "moves"))
    )
    for count in (40, 120):
        one, other = (picture_of(g[:count])[:, :24] for g in (found, left))
        assert eg.psnr(one, image[:, :24]) > eg.psnr(other, image[:, :24]) + 0.5
        assert np.isfinite(picture_of(found[:count])).all()

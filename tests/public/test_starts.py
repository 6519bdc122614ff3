"""What a fit keeps of a start, and how much of it the result and the command say."""

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import said

KEEPS_ALL = eg.DEFAULT.without("places")


@pytest.fixture(scope="module")
def photo():
    return eg.sample("chelsea")[100:164, 150:214]


@pytest.fixture(scope="module")
def fitted(photo):
    return eg.fit(photo, 200, iterations=300)


def collapsed(result, number):
    """The set with the first Gaussians, half of the image, in one spot."""
    arrays = result.gaussians.to_arrays()
    arrays["mean"][:number] = arrays["mean"][:number].mean(0)
    return eg.Gaussians.from_arrays(**arrays, size=(64, 64), space="ycbcr")


def equal(one, other):
    pairs = zip(one.to_arrays().values(), other.to_arrays().values(), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("steps", [20, 100])
def test_half_of_a_start_is_kept_where_it_ends_higher(photo, fitted, steps):
    warm = eg.fit(photo, start=collapsed(fitted, 100), iterations=steps)
    assert 40 < warm.kept < 130
    assert warm.psnr_rgb > eg.fit(photo, 200, iterations=steps).psnr_rgb + 0.2


def test_a_start_that_fits_nowhere_is_placed_anew(photo, fitted):
    cold = eg.fit(photo, 200, iterations=100)
    warm = eg.fit(photo, start=collapsed(fitted, 200), iterations=100)
    assert warm.kept == 0 and cold.kept is None
    assert equal(warm.gaussians, cold.gaussians)


def test_all_of_a_start_is_kept_on_request(photo, fitted):
    """The row before the first step measures the start with the best colours, a heap."""
    start = collapsed(fitted, 200)
    solved = eg.fit(photo, start=start, iterations=0)
    result = eg.fit(photo, start=start, iterations=60, method=KEEPS_ALL)
    assert solved.kept == result.kept == 200
    assert result.trace[0]["psnr_rgb"] == pytest.approx(solved.psnr_rgb, abs=0.2)
    assert result.psnr_rgb > solved.psnr_rgb + 3


def distance(picture, step):
    """A loss that is least at grey."""
    return dr.mean(dr.square(picture - 0.5), axis=None)


def test_every_door_counts(photo, fitted, tmp_path):
    """A weight, a loss with an image and without one, a model, many images in a folder."""
    start = {"start": fitted, "iterations": 3}
    for found in (
        eg.fit(photo, weight=np.ones((64, 64)), **start),
        eg.fit(photo, loss=distance, **start),
        eg.fit(loss=distance, size=(64, 64), **start),
    ):
        assert found.kept == 200
    model, large = eg.EigenGS.load("natural"), eg.sample("coffee")[:96, :96]
    assert eg.fit(large, start=model, iterations=0).kept == len(model.gaussians)
    for _ in range(2):  # the second run takes its figures from the first
        rows = eg.fit_many([photo, 1 - photo], tmp_path, start=fitted, iterations=60)
        assert rows[0].kept == 200 and rows[1].kept < 200


def test_the_command_says_what_is_kept(photo, fitted, tmp_path):
    eg.save_image(tmp_path / "a.png", photo)
    fitted.save(tmp_path / "a.npz")
    collapsed(fitted, 200).save(tmp_path / "heap.npz")
    command = ["fit", tmp_path / "a.png", "-o", tmp_path / "b.npz", "--iterations", "50", "--start"]
    assert "kept 200 of 200 Gaussians of the start\n" in said(*command, tmp_path / "a.npz")
    heap = tmp_path / "heap.npz"
    assert "kept 0 of 200 Gaussians of the start, the others were" in said(*command, heap)
    assert "kept 200 of 200 Gaussians of the start\n" in said(*command, heap, "--keep")


def test_an_exact_picture_reaches_each_goal():
    """127.5 rounds to either side, by errors of floats."""
    result = eg.fit(np.full((32, 32, 3), 0.5, np.float32), target_psnr=60, iterations=100)
    assert result.stopped == "met" and result.psnr_ycbcr > 100

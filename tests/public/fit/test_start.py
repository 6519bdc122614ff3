"""What a fit starts from, what it keeps of it, and how much the result and the command say."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import SIDE, SPLATS, family, small_model
from _helpers.materials import material
from _helpers.sets import check_equal
from _helpers.waves import METHODS, picture

EIGENGS = METHODS["eigengs"]
UNSOLVED = {"iterations": 0, "method": replace(eg.DEFAULT, solve_steps=0)}


@pytest.fixture(scope="module")
def others():
    """Images of the family that were not trained on."""
    return family(8, seed=1)


# --- Models -------------------------------------------------------------------------------------


def test_fit_starts_from_the_exact_colours(backend, others):
    model = small_model(backend)
    result = eg.fit(others[0], iterations=0, start=model, backend=backend)
    expected = eg.render(model.encode(others[0])).numpy()
    assert eg.psnr(result.image, others[0]) == pytest.approx(eg.psnr(expected, others[0]), abs=0.02)
    assert len(result.gaussians) == SPLATS
    assert result.mean_image is None
    image = np.kron(others[0], np.ones((2, 2, 1), np.float32))  # another size is solved again
    result = eg.fit(image, iterations=0, start=model, backend=backend)
    encoded = eg.psnr(eg.render(model.encode(image)), image, "ycbcr")
    assert result.trace[0]["psnr_ycbcr"] >= encoded - 1e-3


def test_fit_by_the_paper(backend, others):
    """Projected colours beside the dense mean image, refined from there."""
    model = small_model(backend)
    result = eg.fit(others[0], iterations=100, method=EIGENGS, start=model, backend=backend)
    shown = model.encode(others[0], "projected", "dense")
    start = eg.psnr(eg.render(shown).numpy() + result.mean_image, others[0], "ycbcr")
    assert result.trace[0]["psnr_ycbcr"] == pytest.approx(start, abs=0.01)
    assert result.trace[-1]["psnr_ycbcr"] > result.trace[0]["psnr_ycbcr"] + 1
    whole = eg.render(result.gaussians).numpy() + result.mean_image
    np.testing.assert_array_equal(whole, result.image)
    reached = eg.psnr(result.image, others[0], "ycbcr")
    assert max(r["psnr_ycbcr"] for r in result.trace) == pytest.approx(reached, abs=1e-3)


# --- Sets ---------------------------------------------------------------------------------------


def test_a_fit_goes_on_from_a_set(backend, others, tmp_path):
    """From a set, a fit, a file, or the set of another size."""
    first = eg.fit(others[0], SPLATS, 20, backend=backend)
    first.save(tmp_path / "set.npz")
    for start in (first.gaussians, first, tmp_path / "set.npz", first.gaussians.scaled(64, 64)):
        again = eg.fit(others[0], start=start, backend=backend, **UNSOLVED)
        np.testing.assert_allclose(again.image, first.image, atol=1e-4)
    film = eg.fit(others[1], start=first, iterations=60, backend=backend)
    start = eg.fit(others[1], start=first, backend=backend, **UNSOLVED)
    assert film.psnr_ycbcr > start.psnr_ycbcr + 3


def test_a_start_is_left_as_it_is(backend, others):
    """Its derivatives, and means outside of the image as long as nothing moves."""
    start = eg.fit(others[0], SPLATS, 0, backend=backend).gaussians
    arrays = start.to_arrays()
    arrays["mean"][0] = -1.5, 3
    start = eg.Gaussians.from_arrays(**arrays, size=(SIDE, SIDE), backend=backend)
    dr.enable_grad(start.mean)
    still = eg.fit(others[0], start=start, backend=backend, **UNSOLVED)
    np.testing.assert_array_equal(still.image, eg.render(start).numpy())
    eg.fit(others[0], start=start, iterations=3, backend=backend)
    assert not dr.any(dr.grad(start.mean) != 0, axis=None)


@pytest.mark.parametrize("space", ["rgb", "linear", "data", "log"])
def test_the_space_is_that_of_the_start(space):
    first = eg.fit(picture(), SPLATS, 5, space=space)
    again = eg.fit(picture(), start=first, iterations=5)
    assert again.gaussians.space == space
    assert again.psnr_ycbcr >= first.psnr_ycbcr - 0.01


# --- What is kept -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def photo():
    return eg.sample("chelsea")[100:164, 150:214]


@pytest.fixture(scope="module")
def fitted(photo):
    return eg.fit(photo, 200, iterations=300)


def collapsed(result, number):
    """The set with the first Gaussians in one spot."""
    arrays = result.gaussians.to_arrays()
    arrays["mean"][:number] = arrays["mean"][:number].mean(0)
    return eg.Gaussians.from_arrays(**arrays, size=(64, 64), space="ycbcr")


@pytest.mark.parametrize("steps", [20, 100])
def test_half_of_a_start_is_kept_where_it_ends_higher(photo, fitted, steps):
    warm = eg.fit(photo, start=collapsed(fitted, 100), iterations=steps)
    assert 40 < warm.kept < 130
    assert warm.psnr_rgb > eg.fit(photo, 200, iterations=steps).psnr_rgb + 0.2


def test_a_start_that_fits_nowhere_is_placed_anew(photo, fitted):
    cold = eg.fit(photo, 200, iterations=100)
    warm = eg.fit(photo, start=collapsed(fitted, 200), iterations=100)
    assert warm.kept == 0 and cold.kept is None
    check_equal(warm.gaussians, cold.gaussians.to_arrays())


def test_all_of_a_start_is_kept_on_request(photo, fitted):
    """The row before the first step measures the start with the best colours, a heap."""
    start, keeps_all = collapsed(fitted, 200), eg.DEFAULT.without("places")
    solved = eg.fit(photo, start=start, iterations=0)
    result = eg.fit(photo, start=start, iterations=60, method=keeps_all)
    assert solved.kept == result.kept == 200
    assert result.trace[0]["psnr_rgb"] == pytest.approx(solved.psnr_rgb, abs=0.2)
    assert result.psnr_rgb > solved.psnr_rgb + 3


def test_every_door_counts(photo, fitted, tmp_path):
    """A weight, a loss with an image and without one, a model, many images in a folder."""

    def distance(picture, step):
        return dr.mean(dr.square(picture - 0.5), axis=None)

    start = {"start": fitted, "iterations": 3}
    for found in (
        eg.fit(photo, weight=np.ones((64, 64)), **start),
        eg.fit(photo, loss=distance, **start),
        eg.fit(loss=distance, size=(64, 64), **start),
    ):
        assert found.kept == 200
    model, large = eg.EigenGS.load("natural"), eg.sample("coffee")[:96, :96]
    assert eg.fit(large, start=model, iterations=0).kept == len(model.gaussians)
    rows = eg.fit_many([photo], tmp_path, start=fitted, iterations=3)
    assert rows[0].kept == 200


def test_each_of_many_images_decides_about_the_start():
    """The start suits one of them; the sets are those of single fits, bit for bit."""
    image, other = (eg.sample(name)[100:132, 200:232] for name in ("coffee", "astronaut"))
    start = eg.fit(image, SPLATS, 100).gaussians
    rows = eg.fit_many([image, other], start=start, iterations=100)
    for row, one in zip(rows, (image, other), strict=True):
        alone = eg.fit(one, start=start, iterations=100)
        np.testing.assert_array_equal(row.result.image, alone.image)


# --- Films --------------------------------------------------------------------------------------


def frame(number, shift):
    """A frame of a camera that moves, as part of a photo."""
    x = 60 + shift * number
    return eg.sample("astronaut")[100:164, x : x + 64]


@pytest.mark.parametrize("shift", [3, 100])
@pytest.mark.parametrize("steps", [20, pytest.param(120, marks=pytest.mark.slow)])
def test_a_film_ends_no_lower_than_fits_of_their_own(shift, steps):
    """Of a camera that moves, and of cuts."""
    start = eg.fit(frame(0, shift), 200, steps)
    for number in (1, 2):
        image = frame(number, shift)
        start, own = eg.fit(image, start=start, iterations=steps), eg.fit(image, 200, steps)
        assert start.psnr_rgb > own.psnr_rgb - 0.3


# --- Mistakes -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"gaussians": 50}, "gaussians is 50, but the start has 100"),
        ({"space": "rgb"}, "space is 'rgb', but the start is in 'ycbcr'"),
        ({"method": EIGENGS, "start": None}, "this method starts from a model; give one as"),
        ({"target_psnr": 30.0}, "target_psnr needs a method that places .* and no start"),
        ({"image": np.zeros((8, 8, 3))}, "100 Gaussians, more than an image of 8x8 has pixels"),
        ({"backend": "cuda"}, "the start is on backend 'llvm', not on 'cuda'"),
        ({"start": [1, 2]}, "list is not a set of Gaussians"),
    ],
)
def test_a_start_that_is_refused(options, words, others):
    options = {"image": others[0], "start": small_model("llvm"), **options}
    with pytest.raises(TypeError if options["start"] == [1, 2] else ValueError, match=words):
        eg.fit(**options)


def test_sets_that_are_no_start_of_an_image(others):
    maps = material()
    with pytest.raises(ValueError, match="the set has the maps albedo, roughness, normal; choose"):
        eg.fit(others[0], start=maps, space="data")
    with pytest.raises(ValueError, match="the image has 3 channels, but the start has 1; use"):
        eg.fit(others[0], start=maps["roughness"], space="data")
    with pytest.raises(ValueError, match="this method starts from a model"):
        eg.fit(others[0], start=maps["albedo"], method=EIGENGS)

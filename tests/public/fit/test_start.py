"""Where a fit starts: from a basis, or from a placement."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import SIDE, SPLATS, family, small_model
from _helpers.halves import objective_of, picture
from eigengs_dr.fitting.place import Grid, Random
from eigengs_dr.fitting.start import keep_fitting
from eigengs_dr.image.resize import resample
from eigengs_dr.image.space import to_planes
from eigengs_dr.paper.eigengs import EIGENGS

places = pytest.mark.parametrize("place", [Grid(), Random()], ids=repr)


@places
def test_other_placements_stay_where_they_were_put(place):
    """They are not placed anew, and have no surplus."""
    method = replace(eg.DEFAULT, place=place)
    plain = method.without("grows", "places")
    one, other = (eg.fit(picture(), 60, 110, method=m) for m in (method, plain))
    np.testing.assert_array_equal(one.image, other.image)


@places
def test_other_placements_gain_from_relocation(place):
    """They are not placed anew, but they relocate in a long descent."""
    image = eg.sample("coffee")[100:164, 200:264]
    method = replace(eg.DEFAULT, place=place)
    moved, left = (
        eg.fit(image, 200, 600, method=m).psnr_rgb
        for m in (method, method.without("grows", "moves", "shakes"))
    )
    assert moved > left + 0.3


@pytest.fixture(scope="module")
def others():
    """Images of the family that were not trained on."""
    return family(8, seed=1)


def test_fit_starts_from_the_exact_colours(backend, others):
    model = small_model(backend)
    result = eg.fit(others[0], iterations=0, start=model, backend=backend)
    expected = eg.render(model.encode(others[0])).numpy()
    assert eg.psnr(result.image, others[0]) == pytest.approx(eg.psnr(expected, others[0]), abs=0.02)
    assert len(result.gaussians) == SPLATS
    assert result.mean_image is None


def test_fit_at_another_size_solves_again(backend, others):
    model, image = small_model(backend), resample(others[0], 60, 44).clip(0, 1)
    result = eg.fit(image, iterations=0, start=model, backend=backend)
    encoded = eg.psnr(eg.render(model.encode(image)), image, "ycbcr")
    assert result.trace[0]["psnr_ycbcr"] >= encoded - 1e-3


def test_fit_by_the_paper(backend, others):
    """Projected colours beside the dense mean image, refined from there."""
    model = small_model(backend)
    result = eg.fit(others[0], iterations=100, method=EIGENGS, start=model, backend=backend)
    shown = model.encode(others[0], "projected", "dense")
    start = (
        to_planes(eg.render(shown).numpy(), "ycbcr") + model.dense_mean(SIDE, SIDE).reshape(-1, 3).T
    )
    error = np.square(start - to_planes(others[0], "ycbcr")).mean()
    assert result.trace[0]["psnr_ycbcr"] == pytest.approx(-10 * np.log10(error), abs=0.01)
    assert result.trace[-1]["psnr_ycbcr"] > result.trace[0]["psnr_ycbcr"] + 1
    whole = eg.render(result.gaussians).numpy() + result.mean_image
    np.testing.assert_array_equal(whole, result.image)
    reached = eg.psnr(result.image, others[0], "ycbcr")
    assert max(r["psnr_ycbcr"] for r in result.trace) == pytest.approx(reached, abs=1e-3)


def test_a_fit_goes_on_from_a_set(backend, others, tmp_path):
    """From a set, a fit, a file, or the set of another size."""
    first = eg.fit(others[0], SPLATS, 20, backend=backend)
    first.save(tmp_path / "set.npz")
    kept = {"iterations": 0, "method": replace(eg.DEFAULT, solve_steps=0), "backend": backend}
    for start in (first.gaussians, first, tmp_path / "set.npz", first.gaussians.scaled(64, 64)):
        again = eg.fit(others[0], start=start, **kept)
        np.testing.assert_allclose(again.image, first.image, atol=1e-4)
    film = eg.fit(others[1], start=first, iterations=60, backend=backend)
    assert film.psnr_ycbcr > eg.fit(others[1], start=first, **kept).psnr_ycbcr + 3
    [row] = eg.fit_many([others[0]], start=first, **kept)
    np.testing.assert_allclose(row.result.image, first.image, atol=1e-4)


def test_a_start_is_left_as_it_is(backend, others):
    """Its derivatives, and means outside of the image as long as nothing moves."""
    start = eg.fit(others[0], SPLATS, 0, backend=backend).gaussians
    arrays = start.to_arrays()
    arrays["mean"][0] = -1.5, 3
    start = eg.Gaussians.from_arrays(**arrays, size=(start.width, start.height), backend=backend)
    dr.enable_grad(start.mean)
    kept = {"iterations": 0, "method": replace(eg.DEFAULT, solve_steps=0), "backend": backend}
    still = eg.fit(others[0], start=start, **kept)
    np.testing.assert_array_equal(still.image, eg.render(start).numpy())
    eg.fit(others[0], start=start, iterations=3, backend=backend)
    assert not dr.any(dr.grad(start.mean) != 0, axis=None)


def test_data_above_1_start_in_their_own_unit(backend):
    data = 50 * picture()[..., :1]
    first = eg.fit(data, SPLATS, 20, space="data", backend=backend)
    method = replace(eg.DEFAULT, solve_steps=0)
    again = eg.fit(data, start=first, iterations=0, method=method, backend=backend)
    np.testing.assert_allclose(again.image, first.image, atol=0.01)
    [row] = eg.fit_many([data], start=first, iterations=0, method=method)
    np.testing.assert_array_equal(row.result.image, again.image)


@pytest.mark.parametrize("space", ["rgb", "linear", "data", "log"])
def test_the_space_is_that_of_the_start(space):
    first = eg.fit(picture(), 60, 5, space=space)
    again = eg.fit(picture(), start=first, iterations=5)
    assert again.gaussians.space == space
    assert again.psnr_ycbcr >= first.psnr_ycbcr - 0.01


def heap(count, size):
    """All Gaussians in one place."""
    mean = np.full((count, 2), 3.0) + np.linspace(0, 1, count)[:, None]
    factor = np.tile([1.0, 0, 1.0], (count, 1))
    return eg.Gaussians.from_arrays(mean, factor, np.zeros((count, 3)), size=size, space="ycbcr")


def test_a_useless_start_is_placed_anew():
    image = eg.sample("coffee")[100:164, 200:264]
    own = eg.fit(image, 150, 300)
    found = eg.fit(image, start=heap(150, (64, 64)), iterations=300)
    assert len(found.gaussians) == 150
    assert found.psnr_ycbcr > own.psnr_ycbcr - 2


def test_a_good_start_is_not_placed_anew():
    """Refined for as long again, it gets better, as it would by more steps."""
    image = eg.sample("coffee")[100:164, 200:264]
    first = eg.fit(image, 150, 300)
    found = eg.fit(image, start=first, iterations=300)
    assert found.psnr_ycbcr > first.psnr_ycbcr


def test_each_of_many_images_decides_about_the_start():
    """The start suits one of them; the sets are those of single fits, bit for bit."""
    image = eg.sample("coffee")[100:132, 200:232]
    other = eg.sample("astronaut")[100:132, 200:232]
    start = eg.fit(image, 60, 300).gaussians
    rows = eg.fit_many([image, other], start=start, iterations=100)
    for row, one in zip(rows, (image, other), strict=True):
        alone = eg.fit(one, start=start, iterations=100)
        np.testing.assert_array_equal(row.result.image, alone.image)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"gaussians": 50}, "gaussians is 50, but the start has 100"),
        ({"space": "rgb"}, "space is 'rgb', but the start is in 'ycbcr'"),
        ({"gaussians": [20, 50]}, "levels need the placement Adaptive and no start"),
        ({"method": EIGENGS, "start": None}, "this method starts from a model; give one as"),
        ({"target_psnr": 30.0}, "target_psnr needs a method that places .* and no start"),
    ],
)
def test_fit_refuses_a_start(backend, options, words, others):
    options = {"start": small_model(backend), **options}
    with pytest.raises(ValueError, match=words):
        eg.fit(others[0], backend=backend, **options)


def test_fit_refuses_what_is_no_start(others):
    with pytest.raises(TypeError, match="list is not a set of Gaussians"):
        eg.fit(others[0], start=[1, 2])
    with pytest.raises(ValueError, match="100 Gaussians, more than an image of 8x8 has pixels"):
        eg.fit(others[0][:8, :8], start=small_model("llvm"), backend="llvm")
    maps = eg.fit({"albedo": others[0], "roughness": others[0][..., 0]}, 30, iterations=0)
    with pytest.raises(ValueError, match="the set has the maps albedo, roughness; choose one"):
        eg.fit(others[0], start=maps, space="data")
    with pytest.raises(ValueError, match="the image has 3 channels, but the start has 1; use"):
        eg.fit(others[0], start=maps.gaussians["roughness"], space="data")
    with pytest.raises(ValueError, match="this method starts from a model"):
        eg.fit(others[0], start=eg.fit(others[0], 30, 0), method=EIGENGS)
    with pytest.raises(ValueError, match="the start is on backend 'llvm', not on 'cuda'"):
        eg.fit(others[0], start=small_model("llvm"), backend="cuda")


def frame(number, shift, side=64):
    """A frame of a camera that moves, as part of a photo."""
    x = 60 + shift * number
    return eg.sample("astronaut")[100 : 100 + side, x : x + side]


@pytest.mark.parametrize("shift", [3, 100])
@pytest.mark.parametrize("steps", [20, 120])
def test_a_film_ends_no_lower_than_fits_of_their_own(shift, steps):
    """Of a camera that moves, and of cuts."""
    start = eg.fit(frame(0, shift), 200, steps)
    for number in (1, 2):
        image = frame(number, shift)
        start, own = eg.fit(image, start=start, iterations=steps), eg.fit(image, 200, steps)
        assert start.psnr_rgb > own.psnr_rgb - 0.3


def test_a_film_of_a_still_scene_gains():
    image = frame(0, 0)
    first = eg.fit(image, 200, 20)
    assert eg.fit(image, start=first, iterations=20).psnr_rgb > first.psnr_rgb + 0.3


def test_gaussians_stay_where_the_image_is_still():
    """Those that an object has left or reached are placed anew."""
    scene, thing = eg.sample("astronaut")[60:156, 40:136], eg.sample("coffee")[150:170, 200:220]
    before, after = scene.copy(), scene.copy()
    before[40:60, 10:30] = after[40:60, 18:38] = thing
    first = eg.fit(before, 400, 40)
    begun, kept = keep_fitting(first.gaussians, objective_of(after), eg.DEFAULT, 40, 0)
    assert kept and len(begun) == 400
    still, moved = first.gaussians.mean.numpy().T, begun.mean.numpy().T
    stays = np.array([(np.abs(moved - mean).max(1) < 1e-4).any() for mean in still])
    reached = ((still > [12, 42]) & (still < [36, 58])).all(1)
    away = ((still < [4, 34]) | (still > [44, 66])).any(1)
    assert stays[away].mean() > 0.7 and stays[reached].mean() < 0.4


@pytest.mark.parametrize("steps", [0, 15, 110])
def test_seeds_place_gaussians_elsewhere(steps):
    """At any number of steps; numbers far apart too."""
    image = frame(0, 0, 32)
    colors = [
        eg.fit(image, 40, steps, seed=s).gaussians.color.numpy() for s in (0, 0, 1, 2**40 + 3)
    ]
    np.testing.assert_array_equal(colors[0], colors[1])
    assert len({color.tobytes() for color in colors}) == 3

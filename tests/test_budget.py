"""The fewest splats for a quality: density by error, worth of splats, the search, `fit`."""

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from scenes import few, scenes

import eigengs_dr as eg
from eigengs_dr.cli.main import main
from eigengs_dr.fitting import search as budget
from eigengs_dr.fitting.density_control import densify, prune, removal_cost
from eigengs_dr.fitting.fit import fit, max_gaussians_for
from eigengs_dr.fitting.initializers import initialize
from eigengs_dr.fitting.placement.adaptive import place_adaptive
from eigengs_dr.fitting.placement.density import (
    ERROR_EXPONENT,
    SUPPRESSION_RADIUS,
    residual_peaks,
    target_density,
)
from eigengs_dr.fitting.presets import PRESETS
from eigengs_dr.fitting.redistribute import redistribute, residual
from eigengs_dr.fitting.search import search_count
from eigengs_dr.fitting.solvers.conjugate_gradient import inner_products
from eigengs_dr.image.color import rgb_to_ycbcr
from eigengs_dr.raster.render import render

SIDE = 32


def picture(seed=0):
    """A smooth half and a busy one, RGB."""
    y, x = np.indices((SIDE, SIDE)) / SIDE
    image = np.stack([0.4 + 0.2 * x, 0.5 + 0.2 * y, 0.6 - 0.2 * x], axis=-1)
    noise = np.random.default_rng(seed).uniform(-0.2, 0.2, (SIDE, SIDE // 2, 3))
    image[:, : SIDE // 2] += noise
    return image.astype(np.float32)


def fitted(count=60):
    image = picture()
    return initialize(image, count, "adaptive", "natural", PRESETS["default"]), rgb_to_ycbcr(image)


def squared_error(gaussians, target, weight=1.0):
    return float(np.square(weight * residual(gaussians, target).astype(np.float64)).sum())


# ---------------------------------------------------------------------------------------------
#  Density by error
# ---------------------------------------------------------------------------------------------


def squares(side):
    """Centres of squares of 5 x 5 pixels."""
    y, x = np.mgrid[2.5:side:5, 2.5:side:5]
    return np.stack([x.ravel(), y.ravel()], axis=1)


def test_equal_shares_of_error_leave_the_density_as_it_was():
    """Splats on a grid, each with the same error: nothing is gained by moving any."""
    density = target_density(squares(30), np.ones((30, 30)), np.ones((30, 30)))
    np.testing.assert_allclose(density, density.mean(), rtol=1e-9)


@pytest.mark.parametrize("times", [0.1, 10.0, 100.0])
def test_density_follows_the_error_by_its_power(times):
    """Far from the border of two halves, densities differ by ``times^(1 / (FALL + 1))``."""
    error = np.ones((60, 60))
    error[:, 30:] = times
    density = target_density(squares(60), error, np.ones((60, 60)))
    ratio = density[:, 50:].mean() / density[:, :10].mean()
    np.testing.assert_allclose(ratio, times ** (1 / (ERROR_EXPONENT + 1)), rtol=1e-6)


def test_that_power_leaves_the_least_error():
    """Of all powers of the error, it is the one whose density misses least: a numerical check."""
    share, tried = np.array([1.0, 30.0]), np.array([0.5, 0.5])
    factor = share * tried**ERROR_EXPONENT * tried  # e = factor rho^-FALL on two equal areas

    def error(power):
        density = tried * share**power
        return (factor * (density / density.sum()) ** -ERROR_EXPONENT).sum()

    powers = np.linspace(0, 1, 2001)
    best = powers[np.argmin([error(p) for p in powers])]
    assert best == pytest.approx(1 / (ERROR_EXPONENT + 1), abs=1e-3)


def test_among_neighbours_density_follows_the_bending():
    mean = np.array([[8.0, 16.0], [24.0, 16.0]])
    bending = np.ones((32, 32))
    bending[:, 4:8] = 5
    density = target_density(mean, np.ones((32, 32)), bending)
    np.testing.assert_allclose(density / density[0, 0], bending, rtol=1e-9)


def test_nothing_missed_and_nothing_bent_is_still_a_density():
    density = target_density(np.array([[5.0, 5.0]]), np.zeros((8, 8)), np.full((8, 8), 1e-30))
    assert np.isfinite(density).all() and (density > 0).all()


@pytest.mark.parametrize("side", [32, 150])
def test_rearranged_has_the_count_and_goes_where_the_error_is(side):
    """Also where splats are so far apart that they are placed on a smaller image."""
    image = np.kron(picture(), np.ones((-(-side // SIDE), -(-side // SIDE), 1)))[:side, :side]
    start = initialize(image.astype(np.float32), 64, "grid", "natural", PRESETS["default"])
    result = redistribute(start.gaussians, 50, start.target, start.target)
    left = result.mean.numpy()[0] < side / 2
    assert len(result) == 50
    assert left.mean() > 0.6  # half of the area, most of the error
    assert np.isfinite(render(result).numpy()).all()


def test_weights_draw_splats():
    start, target = fitted()
    weight = np.ones_like(target)
    weight[SIDE // 2 :] = 1e-3
    result = redistribute(start.gaussians, 60, target, target, weight)
    assert (result.mean.numpy()[1] < SIDE / 2).mean() > 0.7


def test_fits_that_are_long_enough_rearrange_once():
    image = picture()
    calls = []
    start = initialize(image, 60, "adaptive", "natural", PRESETS["default"])

    def rearrange(gaussians, count):
        calls.append(count)
        return start.redistribute(gaussians, count)

    from eigengs_dr.fitting.optimizers.descent import descend
    from eigengs_dr.fitting.optimizers.schedule import MIN_PHASE_RATIO

    schedule = replace(PRESETS["default"].schedule, redistribute_after=2)
    for steps, times in ((2 * MIN_PHASE_RATIO - 1, 0), (2 * MIN_PHASE_RATIO, 1)):
        calls.clear()
        sets = list(descend(start.gaussians, start.target, schedule, steps, redistribute=rearrange))
        assert len(sets) == steps + 1
        assert calls == [60] * times


@pytest.mark.parametrize("init", ["grid", "random", "eigen"])
def test_other_starts_are_not_rearranged(init):
    image = np.tile(picture(), (3, 3, 1)) if init == "eigen" else picture()
    count = None if init == "eigen" else 60
    assert initialize(image, count, init, "natural", PRESETS["default"]).redistribute is None


# ---------------------------------------------------------------------------------------------
#  What a splat is worth
# ---------------------------------------------------------------------------------------------


@few
@given(scenes())
def test_worth_is_the_rise_of_the_error(backend, scene):
    gaussians = scene.on(backend)
    shape = (gaussians.height, gaussians.width, gaussians.channels)
    generator = np.random.default_rng(1)
    target = generator.uniform(0, 1, shape).astype(np.float32)
    weight = generator.uniform(0, 2, shape).astype(np.float32)
    value = removal_cost(gaussians, target, weight)
    before = squared_error(gaussians, target, weight)
    for n in range(min(4, len(gaussians))):
        rest = gaussians[np.arange(len(gaussians)) != n]
        rise = squared_error(rest, target, weight) - before
        assert value[n] == pytest.approx(rise, rel=2e-3, abs=2e-3 * before)


def test_correlations_are_inner_products():
    start, target = fitted(20)
    plain = replace(start.gaussians, space="data")
    ones = np.ones((SIDE, SIDE, 3), np.float32)
    for n in (0, 7):
        one = replace(plain[[n]], color=plain[[n]].color * 0 + 1, background=plain.background * 0)
        weights = render(one).numpy().astype(np.float64)
        first = inner_products(plain, target)[n]
        np.testing.assert_allclose(first, (weights * target).sum((0, 1)), rtol=1e-4, atol=1e-5)
        own = inner_products(plain, ones, squared=True)[n]
        np.testing.assert_allclose(own, (weights**2).sum((0, 1)), rtol=1e-4)


def test_pruned_keeps_what_counts_in_order():
    start, target = fitted()
    color = start.gaussians.to_arrays()["color"]
    value = removal_cost(start.gaussians, target)
    kept = prune(start.gaussians, target, 40)
    best = np.sort(np.argsort(value)[-40:])
    mean = start.gaussians.to_arrays()["mean"]
    np.testing.assert_array_equal(kept.to_arrays()["mean"], mean[best])
    assert np.abs(kept.to_arrays()["color"] - color[best]).max() > 1e-3  # solved for again
    plain = squared_error(start.gaussians[best], target)
    assert squared_error(kept, target) < plain


def test_grown_adds_where_the_error_is():
    target = np.zeros((SIDE, SIDE, 1), np.float32)
    y, x = np.indices((SIDE, SIDE)) + 0.5
    target[..., 0] = np.exp(-((x - 20.5) ** 2 + (y - 9.5) ** 2) / (2 * 2.0**2))
    empty = eg.Gaussians.from_arrays(
        np.full((60, 2), 2.0),
        np.tile([1.0, 0, 1], (60, 1)),
        np.zeros((60, 1)),
        size=(SIDE, SIDE),
        space="data",
        backend="llvm",
    )
    result = densify(empty, target, 61)
    assert len(result) == 61
    np.testing.assert_allclose(result.to_arrays()["mean"][60], [20.5, 9.5])
    assert squared_error(result, target) < 0.2 * squared_error(empty, target)


@pytest.mark.parametrize("deviation", [6.0, 1.5, 0.6])
def test_gain_of_a_place_is_what_a_splat_takes(deviation):
    """Of a residual that is one round splat of a tried size, also where it is below a pixel."""
    y, x = np.indices((64, 64)) + 0.5
    splat = 0.7 * np.exp(-((x - 32.5) ** 2 + (y - 30.5) ** 2) / (2 * deviation**2))
    mean, size, color = residual_peaks(splat[..., None], 1, deviation)
    np.testing.assert_allclose(mean, [[32.5, 30.5]])
    np.testing.assert_allclose(size, [deviation])
    np.testing.assert_allclose(color, [[0.7]], rtol=0.01)


@given(st.integers(0, 40))
def test_places_keep_apart_and_never_exceed(count):
    missed = np.random.default_rng(count).normal(size=(24, 20, 3))
    mean, size, color = residual_peaks(missed, count, 4.0)
    assert len(mean) == len(size) == len(color) <= count
    for k in range(len(mean)):
        away = np.abs(mean[k + 1 :] - mean[k]).max(axis=1)
        assert (away > np.ceil(SUPPRESSION_RADIUS * size[k])).all()


def test_grown_to_fewer_or_as_many_is_the_set():
    start, target = fitted()
    for count in (10, 60):
        assert densify(start.gaussians, target, count) is start.gaussians


def test_grown_of_a_perfect_set_is_the_set():
    start, _ = fitted(20)
    plain = replace(start.gaussians, space="data")
    assert len(densify(plain, render(plain).numpy(), 30)) == 20


# ---------------------------------------------------------------------------------------------
#  The search
# ---------------------------------------------------------------------------------------------


def test_a_constant_image_takes_one_splat():
    result = fit(np.full((SIDE, SIDE, 3), 0.4), target_psnr=60, iterations=100)
    assert (result.stopped, len(result.gaussians)) == ("met", 1)


def test_two_colours_take_few():
    image = np.full((SIDE, SIDE, 3), 0.4, np.float32)
    image[:, SIDE // 2 :] = (0.9, 0.2, 0.1)
    result = fit(image, target_psnr=38, iterations=300)
    assert result.stopped == "met"
    assert len(result.gaussians) <= 12
    assert eg.psnr(image, result.image, space="ycbcr") >= 38


def test_noise_is_out_of_reach():
    noise = np.random.default_rng(0).uniform(0, 1, (SIDE, SIDE, 3))
    result = fit(noise, target_psnr=45, iterations=100)
    assert result.stopped == "out of reach"
    assert len(result.gaussians) <= max_gaussians_for(noise) == SIDE * SIDE * 3 // 8


@pytest.mark.parametrize("space", ["ycbcr", "rgb"])
def test_the_target_is_met_in_its_space(space):
    image = eg.sample("coffee")[100 : 100 + SIDE, 200 : 200 + SIDE]
    plain = fit(image, gaussians=100, iterations=200)
    reached = plain.trace[-1][f"psnr_{space}"]
    found = fit(image, target_psnr=reached, target_space=space, iterations=200)
    assert found.stopped == "met"
    assert eg.psnr(image, found.image, space=space) >= reached
    assert len(found.gaussians) <= 150  # short descents settle less well than one of 200 steps
    last = [row for row in found.trace if row["gaussians"] == len(found.gaussians)][-1]
    assert last[f"psnr_{space}"] >= reached


def test_one_seed_gives_one_result():
    image = picture()
    a, b = (fit(image, target_psnr=28, iterations=60) for _ in range(2))
    np.testing.assert_array_equal(a.image, b.image)


def test_progress_counts_up_to_its_total():
    seen = []
    fit(picture(), target_psnr=30, iterations=50, progress=lambda *row: seen.append(row))
    steps = [row[0] for row in seen]
    assert steps == sorted(steps) and len(steps) > 3
    assert all(step <= total for step, total, _ in seen)
    assert {"gaussians", "psnr_rgb", "psnr_ycbcr", "seconds"} <= seen[-1][2].keys()


def test_interrupted_while_it_settles_it_keeps_the_best():
    """Also by an error, as in a thread or at a second Ctrl-C."""
    whole = fit(picture(), target_psnr=28, iterations=200)
    assert whole.stopped == "met"
    best = [row["gaussians"] for row in whole.trace if row["psnr_ycbcr"] >= 28]

    def press(iteration, iterations, row):
        if row["psnr_ycbcr"] >= 28:  # the search has met its goal, and settles
            raise KeyboardInterrupt

    found = fit(picture(), target_psnr=28, iterations=200, progress=press)
    assert found.stopped == "interrupted"
    assert found.iterations < whole.iterations
    assert len(found.gaussians) == best[0]
    assert eg.psnr(picture(), found.image, space="ycbcr") >= 28


def test_interrupted_it_returns_what_there_is():
    image = picture()
    start = initialize(image, 60, "adaptive", "natural", PRESETS["default"])
    asked = []

    def interrupted():
        asked.append(None)
        return len(asked) > 7

    def measure(gaussians):
        return {"decibels": 10.0}

    schedule = PRESETS["default"].schedule
    result = search_count(
        start, measure, "decibels", 20.0, 100, schedule, 100, interrupted=interrupted
    )
    assert result.stopped == "interrupted"
    assert result.iterations <= 7
    assert len(result.gaussians) <= 100


def test_a_search_whose_goal_is_not_met_ends():
    """Where every round adds a splat or two, by the steps that it has taken."""
    start = initialize(picture(), 60, "adaptive", "natural", PRESETS["default"])
    result = search_count(
        start,
        lambda gaussians: {"decibels": 18.0},
        "decibels",
        20.0,
        10**5,
        PRESETS["default"].schedule,
        40,
    )
    assert result.stopped == "out of reach" and result.iterations <= 80


def test_a_weight_leaves_colours_as_they_are():
    start, target = fitted(60)
    gaussians, weight = start.gaussians, np.ones_like(target)
    kept = prune(gaussians, target, 30, weight)
    value = removal_cost(gaussians, target, weight)
    best = np.sort(np.argsort(-value, kind="stable")[:30])
    np.testing.assert_array_equal(kept.to_arrays()["color"], gaussians[best].to_arrays()["color"])


@pytest.mark.parametrize("octave", [2.5, 4.0, 9.0])
def test_a_search_learns_what_more_splats_gain(octave):
    """Where only their number counts: the fewest are found at any slope."""
    start = initialize(picture(), 60, "adaptive", "natural", PRESETS["default"])
    schedule = PRESETS["default"].schedule

    def measure(gaussians):
        return {"decibels": octave * np.log2(len(gaussians) / 150)}

    result = search_count(start, measure, "decibels", 0.0, 1000, schedule, 40)
    assert result.stopped == "met"
    assert 150 <= len(result.gaussians) <= 152


def searched(monkeypatch, measure):
    """Search for 0 dB, from 60 splats, with descents that move nothing.

    ``measure(gaussians, steps)`` returns decibels, where `steps` lists those of all descents.
    """
    start = initialize(picture(), 60, "adaptive", "natural", PRESETS["default"])
    steps = []

    def stand(gaussians, target, schedule, count, *rest):
        steps.append(count)
        return iter([gaussians] * (count + 1))

    def judge(gaussians):
        return {"decibels": measure(gaussians, steps)}

    monkeypatch.setattr(budget, "descend", stand)
    result = search_count(start, judge, "decibels", 0.0, 1000, PRESETS["default"].schedule, 1000)
    assert result.stopped == "met"
    return result, steps


@pytest.mark.parametrize("octave", [2.0, 4.0, 9.0])
@pytest.mark.parametrize("needed", [60, 150])
def test_a_search_tries_more_than_once_and_fits_once(monkeypatch, octave, needed):
    """Where only their number counts, of which the search begins with 60."""
    _, steps = searched(monkeypatch, lambda g, _: octave * np.log2(len(g) / needed))
    assert steps[:2] == [100, 100]
    assert steps.count(400) == 1


def test_a_search_adds_nothing_where_steps_lead_to_the_goal(monkeypatch):
    """Where every step gains a little: a set that has missed the goal by less is not enlarged."""
    added = []

    def counted(gaussians, target, count, *rest):
        added.append(count - len(gaussians))
        return densify(gaussians, target, count, *rest)

    monkeypatch.setattr(budget, "densify", counted)
    result, _ = searched(
        monkeypatch, lambda g, steps: 4 * np.log2(len(g) / 100) + 0.0005 * sum(steps)
    )
    assert any(row["decibels"] < 0 and row["iteration"] > 600 for row in result.trace)
    assert added
    assert not any(added)


def test_a_search_goes_on_where_the_fit_just_meets_the_goal(monkeypatch):
    """Where the fit ends a hair above the goal, and steps after it gain as much as they do."""
    fitted = []

    def measure(gaussians, steps):
        if steps and steps[-1] == 400:
            fitted.append(len(gaussians))
        needed = fitted[0] if fitted else 100
        settled = sum(count for count in steps if count not in (100, 400))
        return 4 * np.log2(len(gaussians) / needed) + 0.001 + settled / 600

    result, _ = searched(monkeypatch, measure)
    assert len(result.gaussians) < fitted[0]


def test_a_search_ends_where_no_place_is_left_to_grow(monkeypatch):
    start = initialize(picture(), 60, "adaptive", "natural", PRESETS["default"])
    asked = []
    monkeypatch.setattr(budget, "densify", lambda gaussians, *rest: asked.append(1) or gaussians)
    schedule = PRESETS["default"].schedule
    result = search_count(start, lambda g: {"decibels": 18.0}, "decibels", 20.0, 1000, schedule, 40)
    assert result.stopped == "out of reach"
    assert len(asked) == 1


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"gaussians": 10}, "exclude each other"),
        ({"preset": "gaussianimage"}, "works with preset 'default'"),
        ({"init": "random"}, "init 'adaptive'"),
        ({"target_psnr": 0}, "above 0"),
        ({"target_psnr": np.nan}, "above 0"),
        ({"target_psnr": 101}, "at most 100"),
        ({"target_space": "lab"}, "use ycbcr or rgb"),
        ({"max_gaussians": 0}, "takes 1 to 1024"),
        ({"max_gaussians": 2000}, "takes 1 to 1024"),
        ({"max_gaussians": 50.5}, "takes 1 to 1024"),
        ({"target_psnr": None, "max_gaussians": 50}, "belong to target_psnr"),
        ({"target_psnr": None, "target_space": "rgb"}, "belong to target_psnr"),
    ],
)
def test_what_cannot_be_searched_for_is_said_in_one_line(settings, told):
    with pytest.raises(ValueError, match=told) as caught:
        fit(picture(), **({"target_psnr": 30} | settings))
    assert "\n" not in str(caught.value)


def test_density_given_to_adaptive_is_followed():
    image = np.zeros((40, 40, 3), np.float32)

    def left(bend, spacing):
        density = np.full(bend.shape[1:], 1e-6)
        density[:, : bend.shape[2] // 2] = 1
        return density

    mean, _ = place_adaptive(image, 100, density=left)
    assert (mean[:, 0] < 20.5).mean() > 0.95


# ---------------------------------------------------------------------------------------------
#  On the command line
# ---------------------------------------------------------------------------------------------


def run(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


def test_command_finds_few_or_says_that_it_cannot(tmp_path):
    image, out, report = tmp_path / "a.png", tmp_path / "a.npz", tmp_path / "a.json"
    eg.save_image(image, picture())
    base = ["fit", image, "-o", out, "--quiet", "--iterations", 40, "--report", report]
    assert run(*base, "--target-psnr", 26).exit_code == 0
    told = json.loads(report.read_text())
    assert told["stopped"] == "met" and told["psnr_ycbcr"] >= 26
    assert told["gaussians"] == len(eg.Gaussians.load(out))

    result = run(*base, "--target-psnr", 60, "--max-gaussians", 50)
    assert result.exit_code == 1
    assert "60 dB are out of reach: 50 Gaussians have" in result.stderr
    assert len(eg.Gaussians.load(out)) == 50

    assert run(*base, "--target-psnr", 20, "--space", "rgb").exit_code == 0
    assert json.loads(report.read_text())["psnr_rgb"] >= 20

    for option in (("--space", "rgb"), ("--max-gaussians", 50), ("--levels", 2, "--space", "rgb")):
        alone = run(*base, *option)
        assert alone.exit_code == 2 and "belong to --target-psnr" in alone.stderr

    both = run(*base, "--target-psnr", 30, "--gaussians", 9)
    assert both.exit_code == 2
    assert "exclude each other" in both.stderr

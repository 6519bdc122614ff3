"""The search for the fewest splats that reach a PSNR, and `fit` with a target."""

import signal
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import eigengs_dr as eg
from _helpers.halves import SIDE, fitted, picture
from _helpers.photos import coffee
from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.interrupts import Interrupted
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.control import Redistribute
from eigengs_dr.fitting.fit import fit
from eigengs_dr.fitting.loop import Descent
from eigengs_dr.fitting.measure import Measured
from eigengs_dr.fitting.objective import Pixels
from eigengs_dr.fitting.options import Goal, max_gaussians_for
from eigengs_dr.fitting.place import Random
from eigengs_dr.fitting.search import fewest
from eigengs_dr.image.space import DATA
from eigengs_dr.paper.gaussianimage import GAUSSIANIMAGE


def test_two_colours_take_few():
    image = np.full((SIDE, SIDE, 3), 0.4, np.float32)
    image[:, SIDE // 2 :] = (0.9, 0.2, 0.1)
    result = fit(image, target_psnr=32, iterations=300)
    assert result.stopped == "met"
    assert len(result.gaussians) <= 12
    assert eg.psnr(image, result.image) >= 32


def test_noise_is_out_of_reach():
    noise = np.random.default_rng(0).uniform(0, 1, (SIDE, SIDE, 3))
    result = fit(noise, target_psnr=45, iterations=100)
    assert result.stopped == "out of reach"
    assert len(result.gaussians) <= max_gaussians_for(SIDE * SIDE, 3) == SIDE * SIDE * 3 // 8


@pytest.mark.parametrize("space", ["ycbcr", "rgb"])
def test_the_target_is_met_in_its_space(space):
    image = coffee(SIDE)
    plain = fit(image, gaussians=100)
    reached = plain.trace[-1][f"psnr_{space}"]
    found = fit(image, target_psnr=Goal(reached, space))
    assert found.stopped == "met"
    assert eg.psnr(image, found.image, space=space) >= reached
    assert len(found.gaussians) <= 115
    last = [row for row in found.trace if row["gaussians"] == len(found.gaussians)][-1]
    assert last[f"psnr_{space}"] >= reached


def test_short_descents_that_lose_do_not_count():
    """A smooth image, and a placement near the goal: ten steps lose decibels, and say nothing."""
    image = gaussian_filter(eg.sample("coffee")[60:156, 150:246], (3, 3, 0)).astype(np.float32)
    types = types_in(select("llvm"))
    objective = Pixels.of(image, DATA, types)

    def score(gaussians):
        return [Measured({}, eg.psnr(eg.render(gaussians).numpy(), image, "data") - 45)]

    start = eg.DEFAULT.place_and_solve(objective, 800)
    assert score(start)[0].margin > 38 - 45
    found = fewest(Descent(objective, eg.DEFAULT, score), start, 9000, 50)
    assert found.stopped == "met" and len(found.gaussians) < 4000


PLACES = ((40, 100), (70, 120), (100, 140), (130, 160), (160, 180), (200, 220), (220, 300))
"""Corners of parts of a photo: counts of single parts depend on the rounding of a processor."""


@pytest.mark.slow
def test_the_search_finds_about_as_few():
    """Short descents settle less well than one of 200 steps, and single ones by chance."""
    photo, counts = eg.sample("coffee"), []
    for row, column in PLACES:
        image = photo[row : row + SIDE, column : column + SIDE]
        plain = fit(image, gaussians=100, iterations=200)
        found = fit(image, target_psnr=plain.psnr_rgb, iterations=200)
        assert found.stopped == "met"
        counts.append(len(found.gaussians))
    assert np.median(counts) <= 140


def test_progress_counts_up_to_its_total():
    seen = []
    fit(picture(), target_psnr=30, iterations=50, progress=lambda *row: seen.append(row))
    steps = [row[0] for row in seen]
    assert steps == sorted(steps) and len(steps) > 3
    assert all(step <= total for step, total, _ in seen)
    assert {"gaussians", "psnr_rgb", "psnr_ycbcr", "seconds"} <= seen[-1][2].keys()


def test_interrupted_while_it_settles_it_keeps_the_goal_with_fewer():
    """Also by an error, as in a thread or at a second Ctrl-C."""
    whole = fit(picture(), target_psnr=28, iterations=200)
    assert whole.stopped == "met"
    best = [row["gaussians"] for row in whole.trace if row["psnr_rgb"] >= 28]

    def press(iteration, iterations, row):
        if row["psnr_rgb"] >= 28:  # the search has met its goal, and settles
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as interruption:
        fit(picture(), target_psnr=28, iterations=200, progress=press)
    found = interruption.value.result
    assert found.stopped == "interrupted"
    assert found.iterations < whole.iterations
    assert len(found.gaussians) <= best[0]
    assert found.psnr_rgb >= 28
    assert found.psnr_rgb == pytest.approx(eg.psnr(picture(), found.image), abs=1e-3)


def interrupted(image, step, **options):
    """What a search of 200 steps returns after the press of Ctrl-C at a step."""

    def press(iteration, iterations, row):
        if iteration == step:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(Interrupted) as interruption:
        fit(image, iterations=200, progress=press, **options)
    return interruption.value.result


@pytest.mark.parametrize("goal", [26, 28, 30])
def test_interrupted_after_half_its_time_it_is_near_its_goal(goal):
    """The sets of its estimates may be decibels above."""
    assert goal <= interrupted(picture(), 200, target_psnr=goal).psnr_rgb < goal + 1


def test_interrupted_it_has_no_more_than_it_may():
    """Although the fit has a surplus."""
    found = interrupted(coffee(64), 100, target_psnr=Goal(60, max_gaussians=100))
    assert len(found.gaussians) == max(row["gaussians"] for row in found.trace) == 100


@pytest.mark.parametrize("space", ["ycbcr", "rgb", "linear", "log", "data"])
@pytest.mark.parametrize("value", [0.0, 0.4])
def test_an_image_that_is_fitted_without_error(space, value):
    """The PSNR of a set without error is infinite."""
    image = np.full((SIDE, SIDE, 1 if space == "data" else 3), value, np.float32)
    result = fit(image, target_psnr=40, iterations=40, space=space)
    reached = result.psnr_ycbcr if space == "data" else result.psnr_rgb
    assert (len(result.gaussians), result.stopped, reached) == (1, "met", np.inf)


def searched(measure, iterations=40, most=1000, image=None, method=eg.DEFAULT, progress=None):
    """Search for 0 dB, from 60 splats, where ``measure(gaussians)`` returns decibels."""
    gaussians, objective = fitted(60, image=image)

    def score(gaussians):
        decibels = measure(gaussians)
        return [Measured({"decibels": decibels}, decibels)]

    descent = Descent(objective, method, score, progress=progress)
    return fewest(descent, gaussians, most, iterations)


def test_a_search_whose_goal_is_not_met_ends():
    """Where every round adds a splat or two, by the steps that it has taken."""
    result = searched(lambda gaussians: -2.0, most=10**5)
    assert result.stopped == "out of reach" and result.iterations <= 100


@pytest.mark.parametrize("octave", [2.5, 4.0, 9.0])
def test_a_search_learns_what_more_splats_gain(octave):
    """Where only their number counts: the fewest are found at any slope."""
    result = searched(lambda gaussians: octave * np.log2(len(gaussians) / 150))
    assert result.stopped == "met"
    assert 150 <= len(result.gaussians) <= 152


def searched_at_rest(measure):
    """Search with descents of 1,000 steps that move nothing.

    ``measure(gaussians, steps)`` returns decibels, where `steps` lists those of all descents.
    """
    still = replace(eg.DEFAULT.at_rates(1e-30), controls=(Redistribute(),))
    taken, steps = [0], []

    def judge(gaussians):
        if taken[-1] > sum(steps):
            steps.append(taken[-1] - sum(steps))
        return measure(gaussians, steps)

    result = searched(judge, 1000, method=still, progress=lambda step, *_: taken.append(step))
    assert result.stopped == "met"
    return result, steps


@pytest.mark.parametrize(("octave", "needed"), [(2.0, 60), (9.0, 60), (4.0, 150)])
def test_a_search_tries_more_than_once_and_fits_once(octave, needed):
    """Where only their number counts, of which the search begins with 60."""
    _, steps = searched_at_rest(lambda g, _: octave * np.log2(len(g) / needed))
    assert steps[:2] == [100, 100]
    assert steps.count(1000) == 1


def test_a_search_adds_nothing_where_steps_lead_to_the_goal():
    """Where every step gains a little: a set that has missed the goal by less is not enlarged."""
    fitted = []

    def measure(gaussians, steps):
        if steps and steps[-1] == 1000:
            fitted.append(len(gaussians))
        needed = 1.005 * fitted[0] if fitted else 100
        settled = sum(count for count in steps if count not in (100, 1000))
        return 4 * np.log2(len(gaussians) / needed) + 0.0005 * settled

    result, _ = searched_at_rest(measure)
    after = [row for row in result.trace if row["iteration"] > 1000]
    assert after[0]["decibels"] < 0  # the end of the fit
    assert (np.diff([row["gaussians"] for row in after]) <= 0).all()


def test_a_search_goes_on_where_the_fit_just_meets_the_goal():
    """Where the fit ends a hair above the goal, and steps after it gain as much as they do."""
    fitted = []

    def measure(gaussians, steps):
        if steps and steps[-1] == 1000:
            fitted.append(len(gaussians))
        needed = fitted[0] if fitted else 100
        settled = sum(count for count in steps if count not in (100, 1000))
        return 4 * np.log2(len(gaussians) / needed) + 0.001 + settled / 600

    result, _ = searched_at_rest(measure)
    assert len(result.gaussians) < fitted[0]


def test_a_search_grows_on_below_a_try_that_met_the_goal_with_many():
    """Where the fit just misses the goal, and more Gaussians gain less than the tries measured."""
    fitted, seen = [], [0]

    def measure(gaussians, steps):
        placed, seen[0] = len(steps) == seen[0], len(steps)
        if steps and steps[-1] == 1000:
            fitted.append(len(gaussians))
        if fitted:
            return np.log2(len(gaussians) / (1.06 * fitted[0]))
        return 4 * np.log2(len(gaussians) / 20) - 6 * placed

    result, _ = searched_at_rest(measure)
    assert fitted[0] < len(result.gaussians) <= 1.2 * fitted[0]


def test_a_search_ends_where_no_place_is_left_to_grow():
    """After four tries of 4 steps and a fit of 40 steps, where nothing is missed."""
    black = np.zeros((SIDE, SIDE, 3), np.float32)
    result = searched(lambda gaussians: -2.0, image=black)
    assert result.stopped == "out of reach"
    assert result.iterations <= 56


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"gaussians": 10}, "exclude each other"),
        ({"method": GAUSSIANIMAGE}, "needs a method that places Gaussians by the image"),
        ({"method": replace(eg.DEFAULT, place=Random())}, "places Gaussians by the image"),
        ({"method": eg.DEFAULT.without("places")}, "and redistributes them, such as DEFAULT"),
        ({"target_psnr": 0}, "above 0"),
        ({"target_psnr": np.nan}, "above 0"),
        ({"target_psnr": 101}, "at most 100"),
        ({"target_psnr": True}, "psnr is True; it must be a number"),
        ({"target_psnr": lambda: Goal(None)}, "psnr is None; it must be a number"),
        ({"target_psnr": lambda: Goal(30, "lab")}, "use one of rgb, ycbcr"),
        ({"target_psnr": lambda: Goal(30, max_gaussians=0)}, "max_gaussians is 0; it must be at"),
        ({"target_psnr": lambda: Goal(30, max_gaussians=50.5)}, "50.5; it must be a whole number"),
    ],
)
def test_what_cannot_be_searched_for_is_said_in_one_line(settings, told):
    kind = TypeError if "; it must be a " in told else ValueError
    with pytest.raises(kind, match=told) as caught:
        goal = settings.get("target_psnr", 30)
        fit(picture(), **(settings | {"target_psnr": goal() if callable(goal) else goal}))
    assert "\n" not in str(caught.value)

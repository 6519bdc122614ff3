"""A target: the fewest Gaussians that reach a PSNR."""

import signal
from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import SPLATS
from _helpers.halves import SIDE, picture
from _helpers.photos import coffee
from _helpers.waves import METHODS


def test_noise_is_out_of_reach():
    """With as many parameters as the image has numbers; in at most a quarter more than twice the
    steps."""
    noise = np.random.default_rng(0).uniform(0, 1, (SIDE, SIDE, 3))
    result = eg.fit(noise, target_psnr=45, iterations=100)
    assert result.stopped == "out of reach"
    assert len(result.gaussians) <= SIDE * SIDE * 3 // 8
    assert result.iterations <= 2.25 * 100
    black = np.zeros((SIDE, SIDE, 3), np.float32)
    black[8, 8] = 1  # no place is left to grow
    assert eg.fit(black, target_psnr=99, iterations=40).iterations <= 2.25 * 40


@pytest.mark.parametrize("space", ["ycbcr", "rgb"])
def test_the_target_is_met_in_its_space(space):
    image = coffee(SIDE)
    plain = eg.fit(image, SPLATS, iterations=600)
    reached = plain.trace[-1][f"psnr_{space}"]
    found = eg.fit(image, target_psnr=eg.Goal(reached, space), iterations=600)
    assert found.stopped == "met"
    assert eg.psnr(image, found.image, space=space) >= reached
    assert len(found.gaussians) <= 1.15 * SPLATS
    last = [row for row in found.trace if row["gaussians"] == len(found.gaussians)][-1]
    assert last[f"psnr_{space}"] >= reached


@pytest.mark.parametrize("value", [0.4, 0.5])
def test_an_exact_picture_reaches_each_goal(value):
    """Its PSNR of 8 bits is infinite, but 127.5 rounds to either side, by errors of floats."""
    result = eg.fit(np.full((SIDE, SIDE, 3), value, np.float32), target_psnr=60, iterations=40)
    assert (len(result.gaussians), result.stopped) == (1, "met")
    assert result.psnr_ycbcr > 100 and (value == 0.5 or result.psnr_rgb == np.inf)


def test_progress_counts_up_to_its_total():
    seen = []
    eg.fit(picture(), target_psnr=30, iterations=50, progress=lambda *row: seen.append(row))
    steps = [row[0] for row in seen]
    assert steps == sorted(steps) and len(steps) > 3
    assert all(step <= total for step, total, _ in seen)
    assert {"gaussians", "psnr_rgb", "psnr_ycbcr", "seconds"} <= seen[-1][2].keys()


def interrupted(image, when, **options):
    """What a search of 200 steps returns after the press of Ctrl-C."""

    def press(iteration, iterations, row):
        if when(iteration, row):
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(eg.Interrupted) as interruption:
        eg.fit(image, iterations=200, progress=press, **options)
    return interruption.value.result


def test_interrupted_while_it_settles_it_keeps_the_goal_with_fewer():
    whole = eg.fit(picture(), target_psnr=28, iterations=200)
    assert whole.stopped == "met"
    best = [row["gaussians"] for row in whole.trace if row["psnr_rgb"] >= 28]
    found = interrupted(picture(), lambda step, row: row["psnr_rgb"] >= 28, target_psnr=28)
    assert found.stopped == "interrupted"
    assert found.iterations < whole.iterations
    assert len(found.gaussians) <= best[0]
    assert found.psnr_rgb >= 28
    assert found.psnr_rgb == pytest.approx(eg.psnr(picture(), found.image), abs=1e-3)


@pytest.mark.parametrize("goal", [26, 28, 30])
def test_interrupted_after_half_its_time_it_is_near_its_goal(goal):
    """The sets of its estimates may be decibels above."""
    found = interrupted(picture(), lambda step, row: step == 200, target_psnr=goal)
    assert goal <= found.psnr_rgb < goal + 1


def test_interrupted_it_has_no_more_than_it_may():
    """Although the fit has a surplus."""
    goal = eg.Goal(60, max_gaussians=100)
    found = interrupted(coffee(64), lambda step, row: step == 100, target_psnr=goal)
    assert len(found.gaussians) == max(row["gaussians"] for row in found.trace) == 100


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gaussians": 10}, "exclude each other"),
        ({"method": METHODS["gaussianimage"]}, "needs a method that places Gaussians by the image"),
        (
            {"method": replace(eg.DEFAULT, place=METHODS["gaussianimage"].place)},
            "places Gaussians by the image",
        ),
        ({"method": eg.DEFAULT.without("places")}, "and redistributes them, such as DEFAULT"),
        ({"target_psnr": 0}, "above 0"),
        ({"target_psnr": True}, "psnr is True; it must be a number"),
    ],
)
def test_what_cannot_be_searched_for_is_said_in_one_line(settings, message):
    kind = TypeError if "; it must be a " in message else ValueError
    with pytest.raises(kind, match=message) as caught:
        eg.fit(picture(), **{"target_psnr": 30, **settings})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        ((None,), {}, "psnr is None; it must be a number"),
        ((30, "lab"), {}, "use one of rgb, ycbcr"),
        ((30,), {"max_gaussians": 0}, "max_gaussians is 0; it must be at"),
        ((30,), {"max_gaussians": 50.5}, "50.5; it must be a whole number"),
    ],
)
def test_goals_that_are_refused(arguments, options, message):
    with pytest.raises(TypeError if "; it must be a " in message else ValueError, match=message):
        eg.Goal(*arguments, **options)

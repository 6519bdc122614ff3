"""What a Gaussian is worth, which ones leave, and where others take their places."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given

import eigengs_dr as eg
from _helpers.halves import SIDE, fitted, objective_for, picture, squared_error
from _helpers.sets import few, scenes
from eigengs_dr.fitting.control import densify, exchange, exchange_levels, prune, removal_cost
from eigengs_dr.fitting.objective import Part
from eigengs_dr.fitting.placement.peaks import SIZE
from eigengs_dr.image.color import rgb_to_ycbcr
from eigengs_dr.raster.render import render

WEIGHTS = ["none", "pixels", "channels"]
weights = pytest.mark.parametrize("kind", WEIGHTS)


def weight_of(kind, shape):
    """Weights of some pixels, or of their channels; a fifth of the pixels has none."""
    if kind == "none":
        return None
    generator = np.random.default_rng(1)
    counts = generator.uniform(0, 1, shape[:2]) > 0.2
    factors = generator.uniform(0.1, 2, shape) * counts[..., None]
    factors = factors.astype(np.float32)
    return factors if kind == "channels" else factors[..., 0]


def moved(gaussians, objective, share, dropped=0):
    return exchange(gaussians, objective, share, dropped)[0]


@weights
@few
@given(scene=scenes())
def test_worth_is_the_rise_of_the_error(backend, kind, scene):
    gaussians = scene.on(backend)
    shape = (gaussians.height, gaussians.width, gaussians.channels)
    target = np.random.default_rng(1).uniform(0, 1, shape).astype(np.float32)
    objective = objective_for(gaussians, target, weight_of(kind, shape))
    value = removal_cost(gaussians, objective)
    before = squared_error(gaussians, objective)
    for n in range(min(4, len(gaussians))):
        rest = gaussians[np.arange(len(gaussians)) != n]
        rise = squared_error(rest, objective) - before
        assert value[n] == pytest.approx(rise, rel=2e-3, abs=2e-3 * before)


@weights
def test_pruned_keeps_what_counts_in_order(kind):
    gaussians, _ = fitted()
    target = rgb_to_ycbcr(picture())
    objective = objective_for(gaussians, target, weight_of(kind, target.shape))
    color = gaussians.to_arrays()["color"]
    value = removal_cost(gaussians, objective)
    kept = prune(gaussians, objective, 40)
    best = np.sort(np.argsort(value)[-40:])
    mean = gaussians.to_arrays()["mean"]
    np.testing.assert_array_equal(kept.to_arrays()["mean"], mean[best])
    assert np.abs(kept.to_arrays()["color"] - color[best]).max() > 1e-3  # solved for again
    assert squared_error(kept, objective) < squared_error(gaussians[best], objective)


def of_use(*rows, color, count):
    """Data with Gaussians in some places; others, without a colour, lie in a corner."""
    mean = np.array([*rows] + [(2.0, 30.0)] * (count - len(rows)))
    return eg.Gaussians.from_arrays(
        mean,
        np.tile([1 / SIZE, 0, 1 / SIZE], (count, 1)),
        np.array([[color]] * len(rows) + [[0.0]] * (count - len(rows))),
        size=(SIDE, SIDE),
        space="data",
        backend="llvm",
    )


def blobs(*places):
    """An image of blobs of the size of an added Gaussian."""
    y, x = np.indices((SIDE, SIDE)) + 0.5
    sums = sum(np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * SIZE**2)) for u, v in places)
    return sums[..., None].astype(np.float32)


def test_grown_adds_where_the_error_is():
    empty = of_use(color=0.0, count=60)
    objective = objective_for(empty, blobs((20.5, 9.5)))
    result = densify(empty, objective, 61)
    assert len(result) == 61
    np.testing.assert_allclose(result.to_arrays()["mean"][60], [20.5, 9.5])
    assert squared_error(result, objective) < 0.2 * squared_error(empty, objective)


def test_grown_adds_where_the_weight_is():
    """Of two equal blobs the heavier one; nothing where there is no weight."""
    empty, weight = of_use(color=0.0, count=60), np.zeros((SIDE, SIDE), np.float32)
    weight[:, :16], weight[:16, 16:] = 1, 2
    places = (8.5, 24.5), (20.5, 9.5), (24.5, 24.5)
    objective = objective_for(empty, blobs(*places), weight)
    mean = densify(empty, objective, 62).to_arrays()["mean"][60:]
    np.testing.assert_allclose(mean, [places[1], places[0]])


def test_grown_of_a_perfect_set_is_the_set():
    plain = replace(fitted(20)[0], space="data")
    assert len(densify(plain, objective_for(plain, render(plain).numpy()), 30)) == 20


@weights
def test_the_least_useful_move_and_the_others_stay(kind):
    gaussians, _ = fitted()
    target = rgb_to_ycbcr(picture())
    objective = objective_for(gaussians, target, weight_of(kind, target.shape))
    least = np.argsort(removal_cost(gaussians, objective), kind="stable")[:12]
    before = gaussians.to_arrays()
    changed, squares = exchange(gaussians, objective, 0.2)
    mean = changed.to_arrays()["mean"]
    stayed = (mean[:, None] == before["mean"][None]).all(axis=2).any(axis=0)
    assert stayed[np.setdiff1d(np.arange(60), least)].all()
    assert (~stayed[least]).sum() >= 6
    assert float(squares[0]) == pytest.approx(squared_error(gaussians, objective), rel=1e-4)
    assert squared_error(changed, objective) < squared_error(gaussians, objective)


def test_a_gaussian_moves_to_the_error():
    """One blob of the image has a Gaussian, the other has none; the others are of no use."""
    at = [(8.5, 9.5), (22.5, 20.5)]
    before = of_use(at[0], color=1.0, count=40)
    objective = objective_for(before, blobs(*at))
    after = moved(before, objective, 1 / 40)
    assert np.linalg.norm(after.to_arrays()["mean"] - at[1], axis=1).min() < 1
    assert squared_error(after, objective) < 0.2 * squared_error(before, objective)


@pytest.mark.parametrize(("share", "dropped", "left"), [(0.2, 0, 60), (0.2, 5, 55), (0.1, 9, 51)])
def test_the_least_useful_are_dropped(share, dropped, left):
    """The others that leave move; if more are dropped than the share says, none moves."""
    gaussians, objective = fitted()
    leaving = max(int(share * 60), dropped)
    least = np.argsort(removal_cost(gaussians, objective), kind="stable")[:leaving]
    before = gaussians.to_arrays()["mean"]
    found = moved(gaussians, objective, share, dropped)
    mean = found.to_arrays()["mean"]
    assert len(found) == left
    stayed = (mean[:, None] == before[None]).all(axis=2).any(axis=0)
    assert stayed[np.setdiff1d(np.arange(60), least)].all()
    places = leaving - dropped
    assert stayed[least].sum() <= places  # those without a better place
    rest = moved(gaussians, objective, 0.0, leaving)
    gains = squared_error(rest, objective) - squared_error(found, objective)
    assert gains > 0 if places else gains == 0


@pytest.mark.parametrize("counts", [[20, 60], [20, 35, 60]])
def test_levels_relocate_inside_themselves(counts):
    """A quarter of each level, at most, before the same background."""
    gaussians, objective = fitted()
    before = gaussians.to_arrays()
    levels = replace(objective, levels=tuple(counts[:-1]))
    found = exchange_levels(gaussians, levels, 0.25).to_arrays()
    changed = (found["mean"] != before["mean"]).any(axis=1)
    for low, high in pairwise([0, *counts]):
        assert 0 < changed[low:high].sum() <= (high - low) // 4
    np.testing.assert_array_equal(found["background"], before["background"])


def test_a_part_moves_inside_itself():
    """Only its own Gaussians, only to its own pixels, before the same background."""
    gaussians, objective = fitted()
    part = Part(slice(20, 50), (slice(0, 16), slice(8, 32)))
    before = gaussians.to_arrays()
    found = moved(gaussians, replace(objective, part=part), 0.5).to_arrays()
    changed = np.flatnonzero((found["mean"] != before["mean"]).any(axis=1))
    assert 0 < len(changed) <= 15
    assert changed.min() >= 20 and changed.max() < 50
    x, y = found["mean"][changed].T
    assert (x > 7).all() and (y < 17).all()
    np.testing.assert_array_equal(found["background"], before["background"])


def test_neighbours_in_space_stay_so_in_memory():
    gaussians, objective = fitted(400, image=eg.sample("coffee")[:64, :64])
    mean = moved(gaussians, objective, 0.5).to_arrays()["mean"]
    assert np.median(np.linalg.norm(np.diff(mean, axis=0), axis=1)) < 2 * 64 / 400**0.5


def test_a_perfect_set_stays_perfect():
    """Without places for them, Gaussians stay where they are, with the colour 0."""
    gaussians, objective = fitted(40, image=np.full((SIDE, SIDE, 3), 0.25, np.float32))
    after = moved(gaussians, objective, 0.5)
    assert len(after) == 40
    assert squared_error(after, objective) <= squared_error(gaussians, objective) + 1e-6

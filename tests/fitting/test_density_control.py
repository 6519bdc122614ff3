"""What a splat is worth, and which ones are removed or added."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

import eigengs_dr as eg
from _helpers.halves import SIDE, fitted, squared_error
from _helpers.sets import few, scenes
from eigengs_dr.fitting.density_control import densify, prune, removal_cost
from eigengs_dr.fitting.placement.peaks import SIZE
from eigengs_dr.raster.render import render


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
    target[..., 0] = np.exp(-((x - 20.5) ** 2 + (y - 9.5) ** 2) / (2 * SIZE**2))
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


def test_a_weight_leaves_colours_as_they_are():
    start, target = fitted(60)
    gaussians, weight = start.gaussians, np.ones_like(target)
    kept = prune(gaussians, target, 30, weight)
    value = removal_cost(gaussians, target, weight)
    best = np.sort(np.argsort(-value, kind="stable")[:30])
    np.testing.assert_array_equal(kept.to_arrays()["color"], gaussians[best].to_arrays()["color"])


def test_grown_of_a_perfect_set_is_the_set():
    plain = replace(fitted(20)[0].gaussians, space="data")
    assert len(densify(plain, render(plain).numpy(), 30)) == 20

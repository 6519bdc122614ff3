"""Gaussians that move in the course of a descent."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.halves import SIDE, fitted, relocate, squared_error
from eigengs_dr.backend.arrays import types_of
from eigengs_dr.fitting.density_control import Part, relocate_levels, removal_cost
from eigengs_dr.fitting.descent import TiledImage
from eigengs_dr.fitting.options import PRESETS, FitOptions
from eigengs_dr.fitting.placement.peaks import SIZE as ADDED
from eigengs_dr.fitting.schedule import Relocation, relocations
from eigengs_dr.fitting.start import initialize
from eigengs_dr.raster.render import batch_to_tiles

SCHEDULE = PRESETS["default"].schedule


@pytest.mark.parametrize("weighted", [False, True])
def test_the_least_useful_move_and_the_others_stay(weighted):
    start, target = fitted()
    weight = np.full_like(target, 0.5) if weighted else None
    least = np.argsort(removal_cost(start.gaussians, target, weight), kind="stable")[:12]
    kept = np.setdiff1d(np.arange(60), least)
    before = start.gaussians.to_arrays()
    found = relocate(start.gaussians, Relocation(0.2), target, weight).to_arrays()
    for name in ("mean", "factor"):
        np.testing.assert_array_equal(found[name][kept], before[name][kept])
    assert (found["mean"][least] != before["mean"][least]).any(axis=1).sum() >= 6
    assert np.array_equal(found["color"][kept], before["color"][kept]) == weighted


def test_a_gaussian_moves_to_the_error():
    """One blob of the image has a Gaussian, the other has none; the others are of no use."""
    y, x = np.indices((SIDE, SIDE)) + 0.5
    at = [(8.5, 9.5), (22.5, 20.5)]
    target = sum(np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * ADDED**2)) for u, v in at)
    target = target[..., None].astype(np.float32)
    before = eg.Gaussians.from_arrays(
        np.array([at[0]] + [(2.0, 30.0)] * 39),
        np.tile([1 / ADDED, 0, 1 / ADDED], (40, 1)),
        np.array([[1.0]] + [[0.0]] * 39),
        size=(SIDE, SIDE),
        space="data",
        backend="llvm",
    )
    moved = relocate(before, Relocation(1 / 40), target)
    assert np.linalg.norm(moved.to_arrays()["mean"] - at[1], axis=1).min() < 1
    assert squared_error(moved, target) < 0.2 * squared_error(before, target)


@pytest.mark.parametrize("counts", [[20, 60], [20, 35, 60]])
def test_levels_relocate_inside_themselves(counts):
    """A quarter of each level, at most, before the same background; colours are not solved for."""
    start, target = fitted()
    before = start.gaussians.to_arrays()
    tiles = TiledImage(batch_to_tiles(types_of(start.gaussians.mean), target))
    found = relocate_levels(start.gaussians, Relocation(0.25), counts, tiles).to_arrays()
    moved = (found["mean"] != before["mean"]).any(axis=1)
    for low, high in pairwise([0, *counts]):
        assert 0 < moved[low:high].sum() <= (high - low) // 4
    kept = ~moved & found["color"].any(axis=1)  # the others found no place
    np.testing.assert_array_equal(found["color"][kept], before["color"][kept])
    np.testing.assert_array_equal(found["background"], before["background"])


def test_a_part_moves_inside_itself():
    """Only its own Gaussians, only to its own pixels, before the same background."""
    start, target = fitted()
    before, part = start.gaussians.to_arrays(), Part(slice(20, 50), (slice(0, 16), slice(8, 32)))
    found = relocate(start.gaussians, Relocation(0.5), target, part=part).to_arrays()
    moved = np.flatnonzero((found["mean"] != before["mean"]).any(axis=1))
    assert 0 < len(moved) <= 15
    assert moved.min() >= 20 and moved.max() < 50
    x, y = found["mean"][moved].T
    assert (x > 7).all() and (y < 17).all()
    np.testing.assert_array_equal(found["background"], before["background"])


@pytest.mark.parametrize("own", [slice(0, 60), slice(20, 50)])
def test_noise_moves_all_own_gaussians(own):
    """As often as it is asked for with one seed, and the same Gaussians go to peaks."""
    start, target = fitted()
    before, part = start.gaussians.to_arrays(), Part(own, (slice(None), slice(None)))
    sets = [
        relocate(start.gaussians, Relocation(0.2, noise, 3), target, part=part).to_arrays()
        for noise in (0.0, 0.5, 0.5)
    ]
    for name in ("mean", "factor"):
        np.testing.assert_array_equal(sets[1][name], sets[2][name])
        moved = (sets[1][name] != sets[0][name]).any(axis=1)
        np.testing.assert_array_equal(np.flatnonzero(moved), np.arange(60)[own])
        others = np.delete(np.arange(60), own)
        np.testing.assert_array_equal(sets[1][name][others], before[name][others])
    np.testing.assert_array_equal(sets[1]["color"], sets[0]["color"])


def test_neighbours_in_space_stay_so_in_memory():
    problem = initialize(eg.sample("coffee")[:64, :64], FitOptions(gaussians=400, backend="llvm"))
    tiles = TiledImage(batch_to_tiles(types_of(problem.gaussians.mean), problem.target))
    mean = problem.control.relocate(problem.gaussians, Relocation(0.5), tiles).to_arrays()["mean"]
    assert np.median(np.linalg.norm(np.diff(mean, axis=0), axis=1)) < 2 * 64 / 400**0.5


def test_a_perfect_set_stays_perfect():
    """Without places for them, Gaussians stay where they are, with the colour 0."""
    flat = np.full((SIDE, SIDE, 3), 0.25, np.float32)
    start = initialize(flat, FitOptions(gaussians=40, init="adaptive"))
    moved = relocate(start.gaussians, Relocation(0.5), start.target)
    assert len(moved) == 40
    assert squared_error(moved, start.target) <= squared_error(start.gaussians, start.target) + 1e-6


def test_rounds_end_after_two_thirds():
    assert relocations(SCHEDULE, 100) == {}
    assert list(relocations(SCHEDULE, 140)) == [46, 91]
    assert list(relocations(SCHEDULE, 1000)) == [round(650 * k / 14) for k in range(1, 15)]
    assert list(relocations(SCHEDULE, 100_000))[-1] == 65_000
    assert relocations(replace(SCHEDULE, relocate_every=0), 1000) == {}


def test_noise_falls_and_seeds_differ():
    rounds = list(relocations(replace(SCHEDULE, relocate_every=65, noise=3.0), 1000).values())
    np.testing.assert_allclose([move.noise for move in rounds], 3 * np.linspace(1, 0.1, 10))
    assert len({move.seed for move in rounds}) == 10


@pytest.mark.parametrize("count", [1, 9])
def test_sets_too_small_for_a_share_keep_their_gaussians(count):
    assert len(eg.fit(eg.sample("coffee")[:32, :32], count).gaussians) == count

"""Refinement: the loop over steps, on any image, however it goes."""

from dataclasses import replace

import drjit as dr
import drjit.opt
import numpy as np
import pytest
from drjit import JitFlag
from scenes import Scene, random_scene

from eigengs_dr.fitting.optimizers.descent import descend
from eigengs_dr.fitting.presets import PRESETS
from eigengs_dr.fitting.refine import refine, trace_steps
from eigengs_dr.image.color import rgb_to_ycbcr
from eigengs_dr.raster.render import render

SIDE, SPLATS = 32, 100
"""Size of the pictures that are fitted, and splats in a fit: one set of kernels."""

presets = pytest.mark.parametrize("preset", PRESETS)


def picture(height=SIDE, width=SIDE):
    """Waves and an edge, in RGB."""
    y, x = np.indices((height, width)) / SIDE
    waves = [np.sin(9 * x + 4 * y), np.sin(5 * y * y), np.cos(7 * x * y + 1)]
    image = 0.5 + 0.3 * np.stack(waves, axis=-1)
    image[(x - 0.3) ** 2 + (y - 0.6) ** 2 < 0.05] *= 0.4
    return image.astype(np.float32)


def figures(result):
    return [row["psnr_ycbcr"] for row in result.trace]


def start(backend, count=SPLATS, seed=0):
    """Splats at random places, in YCbCr, and the picture there."""
    scene = random_scene(seed, count, (SIDE, SIDE))
    mean = np.clip(scene.mean, 0, SIDE)
    gaussians = scene._replace(mean=mean, color=0 * scene.color).on(backend, space="ycbcr")
    return gaussians, rgb_to_ycbcr(picture())


def default(**changed):
    return replace(PRESETS["default"].schedule, **changed)


@presets
def test_refinement_descends(backend, preset):
    gaussians, target = start(backend)
    result = refine(gaussians, target, picture(), PRESETS[preset].schedule, 100)
    psnrs = figures(result)
    assert [row["iteration"] for row in result.trace] == [0, 10, 20, 50, 100]
    assert psnrs == sorted(psnrs)
    assert psnrs[-1] > psnrs[0] + 1
    assert (result.iterations, result.stopped) == (100, "iterations")


def test_the_first_step_follows_the_gradient(backend):
    """One step of a size too small to matter lowers the squared error as the gradient says."""
    gaussians, target = start(backend)
    rate = 1e-4
    schedule = default(rates=dict.fromkeys(("mean", "factor", "color"), rate), warm_up=0)
    before, after = (
        np.square(render(g.__class__(**{**vars(g), "space": "rgb"})).numpy() - target).mean()
        for g in descend(gaussians, target, schedule, 1)
    )
    assert before * 0.9 < after < before


def test_descend_yields_the_start_and_every_step(backend):
    gaussians, target = start(backend)
    sets = list(descend(gaussians, target, default(), 5))
    assert len(sets) == 6
    for name, value in gaussians.to_arrays().items():
        np.testing.assert_array_equal(sets[0].to_arrays()[name], value)
        if name != "background":
            assert not np.array_equal(sets[5].to_arrays()[name], value)


def test_sets_that_were_yielded_stay_as_they_are(backend):
    """Else the best set so far gets the colours of the last step."""
    gaussians, target = start(backend)
    sets, copies = [], []
    for current in descend(gaussians, target, default(), 6):
        sets.append(current)
        copies.append(current.to_arrays())
    for current, copy in zip(sets, copies, strict=True):
        for name, value in current.to_arrays().items():
            np.testing.assert_array_equal(value, copy[name])


def test_refinement_leaves_its_input_alone(backend):
    gaussians, target = start(backend)
    before, copy = gaussians.to_arrays(), target.copy()
    refine(gaussians, target, picture(), default(), 10)
    for name, value in gaussians.to_arrays().items():
        np.testing.assert_array_equal(value, before[name])
    np.testing.assert_array_equal(target, copy)


@presets
def test_freezing_changes_nothing(backend, preset):
    """Over several builds of the lists, which grow and shrink."""
    gaussians, target = start(backend)
    schedule = PRESETS[preset].schedule
    frozen = [g.to_arrays() for g in descend(gaussians, target, schedule, 20)]
    with dr.scoped_set_flag(JitFlag.KernelFreezing, False):
        traced = [g.to_arrays() for g in descend(gaussians, target, schedule, 20)]
    for name, value in frozen[-1].items():
        np.testing.assert_allclose(value, traced[-1][name], rtol=1e-5, atol=1e-5)


def test_other_runs_change_nothing(backend):
    """Programs of other counts, sizes and rates between two equal runs."""
    gaussians, target = start(backend)
    first = figures(refine(gaussians, target, picture(), default(), 10))
    for count in (200, 50, 1):
        refine(*start(backend, count), picture(), default(rates=default().rates), 10)
    refine(gaussians, target, picture(), PRESETS["gaussianimage"].schedule, 10)
    assert figures(refine(gaussians, target, picture(), default(), 10)) == first


@pytest.mark.parametrize("seed", range(3))
def test_all_splats_on_one_pixel(backend, seed):
    rng = np.random.default_rng(seed)
    mean, factor = np.full((SPLATS, 2), 16.0), np.tile([0.5, 0, 0.5], (SPLATS, 1))
    color = rng.uniform(0, 1e-3, (SPLATS, 3))
    gaussians = Scene(mean, factor, color, np.zeros(3), (SIDE, SIDE)).on(backend, space="ycbcr")
    result = refine(gaussians, rgb_to_ycbcr(picture()), picture(), default(), 60)
    assert np.isfinite(figures(result)).all()
    assert all(np.isfinite(v).all() for v in result.gaussians.to_arrays().values())
    assert figures(result)[-1] > figures(result)[0] + 1


def test_plateau(backend):
    """Ten steps that gain less than a thousand decibels are one."""
    gaussians, target = start(backend)
    schedule = default(patience=10, least_gain=1000.0)
    result = refine(gaussians, target, picture(), schedule, 100)
    assert (result.iterations, result.stopped) == (10, "plateau")
    assert result.trace[-1]["iteration"] == 10


class Spy(drjit.opt.Adam):
    """Adam that remembers its rates."""

    def set_learning_rate(self, value=None, /, **named):
        super().set_learning_rate(value, **named)
        if isinstance(value, dict):
            self.seen.append({k: v[0] for k, v in value.items()})


@pytest.mark.parametrize("warm_up", [0, 4])
def test_rates(backend, warm_up):
    """A linear rise times half a cosine, which ends near what `decay` leaves."""
    seen, steps = [], 40
    schedule = default(
        optimizer=type("Spied", (Spy,), {"seen": seen}),
        rates={"mean": 0.1, "factor": 0.2, "color": 0.3},
        decay=0.25,
        warm_up=warm_up,
    )
    list(descend(*start(backend), schedule, steps))
    assert len(seen) == steps
    step = np.arange(steps)
    left = 0.25 + 0.75 * 0.5 * (1 + np.cos(np.pi * step / steps))
    if warm_up:
        left *= np.minimum(1, (step + 1) / warm_up)
    for name, rate in schedule.rates.items():
        np.testing.assert_allclose([s[name] for s in seen], rate * left, rtol=1e-5)


@pytest.mark.parametrize("iterations", [0, 1, 10, 55, 100, 250])
def test_rows_of_the_trace(iterations):
    usual = [0, 10, 20, 50, *range(100, iterations, 100)]
    assert sorted(trace_steps(iterations)) == sorted(
        {m for m in usual if m <= iterations} | {iterations}
    )


def test_weights(backend):
    """What weighs nothing may be anything; ones are no weights."""
    gaussians, target = start(backend)
    weight, other = np.ones_like(target), target.copy()
    weight[:, SIDE // 2 :], other[:, SIDE // 2 :] = 0, 7

    def colors(*arguments):
        *_, last = descend(gaussians, *arguments)
        return last.to_arrays()["color"]

    left, plain = (colors(target, default(), 10, 3.0, w) for w in (weight, np.ones_like(target)))
    np.testing.assert_array_equal(colors(other, default(), 10, 3.0, weight), left)
    np.testing.assert_array_equal(colors(target, default(), 10), plain)
    assert not np.array_equal(left, plain)

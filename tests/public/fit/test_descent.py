"""Descent and refinement: the steps, their rates, weights and lists, on any image."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from drjit import JitFlag

import eigengs_dr as eg
from _helpers.halves import objective_for, objective_of, squared_error
from _helpers.sets import Scene, check_equal, random_scene
from _helpers.waves import METHODS, SIDE, SPLATS, picture, start, still
from eigengs_dr.backend.arrays import types_in, upload_rows
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.control import Perturb
from eigengs_dr.fitting.loop import descend, last
from eigengs_dr.fitting.objective import Pixels
from eigengs_dr.fitting.state import Adam, begin
from eigengs_dr.fitting.step import (
    MAX_RATE_SCALE,
    next_build,
    rate_scale_of,
    rate_table,
    started,
)
from eigengs_dr.image.color import rgb_to_ycbcr
from eigengs_dr.raster.render import bin_gaussians

kinds = pytest.mark.parametrize("kind", ["default", "gaussianimage"])


def end_of(gaussians, objective, method, steps, **options):
    """The last set of a descent."""
    return last(descend(objective, method, begin(gaussians), steps, **options), gaussians)


def test_descend_yields_the_set_after_every_step(backend):
    """They stay as they are: else the best set so far gets the colours of the last step."""
    gaussians, objective = start(backend)
    sets, copies = [], []
    for state in descend(objective, still(), begin(gaussians), 5):
        sets.append(state.gaussians)
        copies.append(state.gaussians.to_arrays())
    assert len(sets) == 5
    for name, value in gaussians.to_arrays().items():
        found = [current.to_arrays()[name] for current in sets]
        np.testing.assert_array_equal(found, [copy[name] for copy in copies])
        assert name == "background" or not np.array_equal(found[0], value)
        assert name == "background" or not np.array_equal(found[4], found[0])


def test_no_steps_leave_the_set(backend):
    gaussians, objective = start(backend)
    assert end_of(gaussians, objective, eg.DEFAULT, 0).to_arrays().keys()
    for name, value in gaussians.to_arrays().items():
        found = end_of(gaussians, objective, eg.DEFAULT, 0).to_arrays()[name]
        np.testing.assert_array_equal(found, value)


@kinds
def test_freezing_changes_nothing(backend, kind):
    """Over several builds of the lists, which grow and shrink."""
    gaussians, objective = start(backend)
    method, ends = replace(METHODS[kind], drift=0.3 * METHODS[kind].drift), []
    for recorded in (True, False):
        with dr.scoped_set_flag(JitFlag.KernelFreezing, recorded):
            ends.append(end_of(gaussians, objective, method, 8).to_arrays())
    for name, value in ends[0].items():
        np.testing.assert_allclose(value, ends[1][name], rtol=1e-5, atol=1e-5)


def test_a_part_of_the_steps(backend):
    """Two parts of a descent without momentum are the whole: rates are those of their steps."""
    gaussians, objective = start(backend)
    method = still(
        optimizer=Plain(), coordinates=Fields(), rates={"color": 5.0}, warm_up=0, controls=()
    )
    whole = end_of(gaussians, objective, method, 20)
    first = end_of(gaussians, objective, method, 20, part=range(12))
    second = end_of(first, objective, method, 20, part=range(12, 20))
    np.testing.assert_allclose(second.color.numpy(), whole.color.numpy(), rtol=1e-5, atol=1e-6)
    assert squared_error(whole, objective) < 0.9 * squared_error(gaussians, objective)


@pytest.mark.parametrize("places", [False, True])
def test_rates(backend, places):
    """Half a cosine, which ends near what `decay` leaves; another one before a redistribution."""
    steps, rates = 200, {"mean": 0.1, "factor": 0.2, "color": 0.3}
    method = replace(eg.DEFAULT, rates=rates, decay=0.25)
    method = method if places else method.without("places")
    factors = method.rate_factors(steps)
    table = rate_table(types_in(select(backend)), method, factors).numpy().reshape(steps, 3)
    lengths = (20, 180) if places else (200,)
    left = [0.25 + 0.75 * 0.5 * (1 + np.cos(np.pi * np.arange(n) / n)) for n in lengths]
    expected = np.outer(np.concatenate(left), list(rates.values()))
    np.testing.assert_allclose(table, expected, rtol=1e-5)


@pytest.mark.parametrize("warm_up", [0, 4])
def test_steps_grow_after_each_start_of_the_optimiser(backend, warm_up):
    """Without momentum, a first step of Adam is as long as its rate; so are they after a control.

    Colours move by the rate of colours, where their gradient keeps its sign.
    """
    gaussians, objective = start(backend)
    method = replace(
        eg.DEFAULT,
        controls=(Perturb(0.0, every=8),),
        optimizer=Adam(0.0, 0.0, 1e-12),
        rates={"color": 1e-5},
        warm_up=warm_up,
        decay=1.0,
        rate_exponent=0.0,
    )
    colors = [gaussians.to_arrays()["color"]]
    for state in descend(objective, method, begin(gaussians), 32):
        colors.append(state.gaussians.to_arrays()["color"])
    moves = np.median(np.abs(np.diff(np.array(colors, float), axis=0)), axis=(1, 2)) / 1e-5
    first = min(method.controls[0].steps(32))
    assert 8 < first < 16
    for since in (0, first):
        expected = [min(1, (k + 1) / max(1, warm_up)) for k in range(5)]
        np.testing.assert_allclose(moves[since : since + 5], expected, atol=0.02)


def solved(backend, seed, count):
    """Placed Gaussians with the best colours, and a part of a photo: every step is small."""
    top, left = np.random.default_rng(seed).integers(0, (144, 344))
    photo = eg.sample("coffee")[top : top + 256 : 2, left : left + 256 : 2]
    objective = objective_of(photo, backend)
    return eg.DEFAULT.place_and_solve(objective, count), objective


MANY_AND_LARGE = pytest.mark.parametrize("count", [1200, 30], ids=["many", "large"])
"""Gaussians in 128x128 pixels: of 1.5 or of 15 pixels, which move by more than a tile in a step."""


@MANY_AND_LARGE
@kinds
def test_lists_that_last_are_as_good_as_lists_of_every_step(backend, kind, count):
    """A drift of 0 builds lists in every step. Rounding changes most fits by 0.03 dB or less."""
    method, gains = replace(METHODS[kind], controls=()), []
    for seed in range(5):
        gaussians, objective = solved(backend, seed, count)
        lasting, fresh = (
            end_of(gaussians, objective, m, 40) for m in (method, replace(method, drift=0.0))
        )
        errors = [squared_error(g, objective) for g in (lasting, fresh)]
        gains.append(-10 * np.log10(errors[0] / errors[1]))
    assert abs(np.median(gains)) < 0.03


def pairs_of(lists):
    """The pairs of a tile and a Gaussian in lists."""
    splat, begin, end, order = (
        v.numpy().astype(int) for v in (lists.splat, lists.begin, lists.end, lists.order)
    )
    return {(t, n) for t, i, j in zip(order, begin, end, strict=True) for n in splat[i:j].tolist()}


@MANY_AND_LARGE
def test_lists_that_last_hold_what_gaussians_reach(backend, count):
    """Else a fit would hardly be worse, but gradients would lack what lists miss.

    Just before the next build, lists miss 0.15 and 0.27 of the pairs that they would miss without a
    margin, which are 4 and 6 % of all.
    """
    gaussians, objective = solved(backend, 0, count)
    method, steps, stop = still(controls=()), 40, 0
    states = descend(objective, method, begin(gaussians), steps)
    sets = [gaussians, *(state.gaussians for state in states)]
    missed = []
    while stop < steps:
        built = sets[stop]
        stop, moves = next_build(method, method.drift, method.rate_factors(steps), stop, steps)
        margin = method.coordinates.reach(gaussians, moves)
        needed = pairs_of(bin_gaussians(sets[stop - 1]))
        held = (pairs_of(bin_gaussians(built, *m)) for m in (margin, ()))
        missed.append([len(needed - pairs) / len(needed) for pairs in held])
    with_margin, without = np.mean(missed, axis=0)
    assert with_margin < 0.57 * without


def test_what_weighs_nothing_may_be_anything(backend):
    """Equal weights are none."""
    gaussians, _ = start(backend)
    target = rgb_to_ycbcr(picture())
    weight, other = np.ones((SIDE, SIDE), np.float32), target.copy()
    weight[:, SIDE // 2 :], other[:, SIDE // 2 :] = 0, 7

    def colors(target, weight=None):
        objective = objective_for(gaussians, target, weight)
        return end_of(gaussians, objective, still(), 10).to_arrays()["color"]

    left, plain = (colors(target, w) for w in (weight, np.ones_like(target)))
    np.testing.assert_array_equal(colors(other, weight), left)
    np.testing.assert_array_equal(colors(target), plain)
    assert not np.array_equal(left, plain)


@pytest.mark.parametrize("layers", [0, 1, 3])
@pytest.mark.parametrize("name", ["mean", "factor", "color"])
def test_the_gradient_is_that_of_finite_differences(backend, name, layers):
    """A step of plain gradient descent in double precision, with weights of some kinds, and 0."""
    scene = random_scene()
    gaussians = replace(scene.on(backend, 64), cutoff=9.0)
    generator = np.random.default_rng(2)
    target = generator.uniform(0, 1, (*scene.size[::-1], 3)).astype(np.float32)
    shape = (*target.shape[:2], layers) if layers else target.shape[:2]
    weight = generator.uniform(0, 1, shape).astype(np.float32)
    weight[3:8, 3:8] = 0
    objective = objective_for(gaussians, target, weight)
    factors = np.broadcast_to(weight.reshape(*target.shape[:2], -1), target.shape)

    def loss(changed):
        return (factors * np.square(changed.exact(9.0) - target)).mean()

    method = still(
        optimizer=Plain(),
        coordinates=Fields(),
        rates={name: 1.0},
        warm_up=0,
        decay=1.0,
        rate_exponent=0.0,
        controls=(),
    )
    moved = end_of(gaussians, objective, method, 1).to_arrays()[name]
    slope = getattr(scene, name) - moved
    direction = generator.normal(size=slope.shape)
    ends = [scene._replace(**{name: getattr(scene, name) + s * 1e-5 * direction}) for s in (1, -1)]
    expected = (loss(ends[0]) - loss(ends[1])) / 2e-5
    assert (slope * direction).sum() == pytest.approx(expected, rel=1e-4, abs=1e-8)


class Plain:
    """Gradient descent."""

    def start(self, value):
        return ()

    def step(self, value, gradient, moments, rate, time):
        return value - rate * gradient, moments


class Fields:
    """The fields of a set as variables, without bounds."""

    def encode(self, gaussians):
        return {name: getattr(gaussians, name) for name in ("mean", "factor", "color")}

    def decode(self, fixed, variables, size=None):
        return replace(fixed, **variables)

    def project(self, fixed, variables, size=None):
        return variables

    def reach(self, fixed, moves):
        return 0.0, 1.0


def factors_of_rates(color, exponent=0.5, backend="llvm"):
    """Factors (M, N) of the Gaussians of M images, for colours (M, N, C)."""
    types = types_in(select(backend), 64)
    rows = upload_rows(types.Float, color.reshape(-1, color.shape[2]).T)
    return rate_scale_of(rows, exponent, len(color)).numpy().reshape(color.shape[:2])


@pytest.mark.parametrize(
    ("color", "expected"),
    [
        ([[0.3, 0.4, 0.0], [0.0, 0.0, 1.0], [-1.5, 0.0, 0.0]], [2**0.5, 1, 1.5**-0.5]),
        ([[0.0], [1e-30], [1.0], [1e6]], [MAX_RATE_SCALE] * 3 + [1 / MAX_RATE_SCALE]),
        ([[0.0], [0.0]], [1, 1]),
    ],
)
def test_rates_fall_with_the_root_of_the_colour(backend, color, expected):
    """Within bounds, and unless there is no colour at all."""
    np.testing.assert_allclose(
        factors_of_rates(np.array([color]), backend=backend), [expected], rtol=1e-6
    )


def test_a_descent_starts_with_the_factors_of_its_set(backend):
    gaussians, method = random_scene().on(backend), eg.DEFAULT
    found = started(begin(gaussians), method, 0).moving.rate_scale.numpy()
    color = gaussians.to_arrays()["color"].astype(np.float64)
    expected = factors_of_rates(color[None], method.rate_exponent)[0]
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    plain = replace(method, rate_exponent=0.0)
    assert started(begin(gaussians), plain, 0).moving.rate_scale is None


def test_other_runs_change_nothing(backend):
    """Programs of other counts, sizes and rates between two equal runs."""
    gaussians, objective = start(backend)
    first = end_of(gaussians, objective, eg.DEFAULT, 10).to_arrays()
    for count in (200, 50, 1):
        end_of(*start(backend, count), still(rates=dict(eg.DEFAULT.rates)), 10)
    end_of(gaussians, objective, METHODS["gaussianimage"], 10)
    check_equal(end_of(gaussians, objective, eg.DEFAULT, 10), first)


@pytest.mark.parametrize("seed", range(3))
def test_all_splats_on_one_pixel(backend, seed):
    rng = np.random.default_rng(seed)
    mean, factor = np.full((SPLATS, 2), 16.0), np.tile([0.5, 0, 0.5], (SPLATS, 1))
    color = rng.uniform(0, 1e-3, (SPLATS, 3))
    gaussians = Scene(mean, factor, color, np.zeros(3), (SIDE, SIDE)).on(backend, space="ycbcr")
    objective = Pixels.plain(rgb_to_ycbcr(picture()), gaussians)
    end = end_of(gaussians, objective, eg.DEFAULT, 60)
    assert all(np.isfinite(v).all() for v in end.to_arrays().values())
    assert squared_error(end, objective) < 0.8 * squared_error(gaussians, objective)

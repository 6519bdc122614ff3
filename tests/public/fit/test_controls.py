"""Controls: what each does to the sets of a descent, seen by a control that watches it."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.halves import picture
from _helpers.sets import check_equal
from _helpers.waves import CONTROLS, often

COUNT, SIDE = 30, 32
PHOTO = eg.sample("coffee")[100:164, 200:264]


@dataclass(eq=False)
class Watch:
    """Takes the place of a control, and keeps the sets before and after it."""

    watched: object
    acts: list = field(default_factory=list)

    def __getattr__(self, name):
        return getattr(self.watched, name)  # its phase, its settings

    def steps(self, iterations):
        return self.watched.steps(iterations)

    def __call__(self, state, objective, step, iterations, key):
        found = self.watched(state, objective, step, iterations, key)
        self.acts.append((step, state, found))
        return found

    @property
    def sets(self):
        """Pairs of sets, before and after each act."""
        return [(before.gaussians, after.gaussians) for _, before, after in self.acts]


def watched(control, image=None, count=COUNT, steps=1000, others=(), **options):
    """What a control does alone, or after others, in a fit in RGB."""
    watch = Watch(control)
    method = replace(eg.DEFAULT, controls=(*others, watch))
    image = picture() if image is None else image
    return watch, eg.fit(image, count, steps, method=method, space="rgb", **options)


def squared_error(gaussians, image):
    return float(np.square(eg.render(gaussians).numpy() - image, dtype=np.float64).sum())


def stays(before, after):
    """Which Gaussians of a set have kept their place and shape in another."""
    one, other = (np.concatenate([*g.mean.numpy(), *g.factor.numpy()]) for g in (before, after))
    one, other = one.reshape(5, -1).T, other.reshape(5, -1).T
    return (np.abs(one[:, None] - other[None]) < 1e-4).all(axis=2).any(axis=1)


# --- When they act -------------------------------------------------------------------------------


def test_when_they_act():
    """Rounds end after two thirds; a redistribution comes after a tenth of a short descent."""
    relocate, redistribute = CONTROLS["Relocate"], CONTROLS["Redistribute"]
    rounds = [round(650 * k / 14) for k in range(1, 15)]
    assert relocate.steps(1000) == CONTROLS["Perturb"].steps(1000) == rounds
    assert (relocate.steps(100), relocate.steps(140)) == ([], [46, 91])
    assert relocate.steps(100_000)[-1] == 65_000
    assert replace(relocate, every=0).steps(1000) == []
    steps = (0, 99, 100, 150, 200, 100_000)
    assert [redistribute.steps(n) for n in steps] == [(), (), (10,), (15,), (20,), (20,)]
    assert replace(redistribute, after=0).steps(1000) == ()
    assert CONTROLS["Retreat"].steps(200) == [10, 20, 40, 80, 160]


# --- Each alone ----------------------------------------------------------------------------------


def test_a_redistribution_places_all_anew():
    """The descent after it ends higher."""
    watch, found = watched(CONTROLS["Redistribute"], PHOTO, 150, 200)
    [(before, after)] = watch.sets
    assert len(after) == 150 and not stays(before, after).any()
    plain = eg.fit(PHOTO, 150, 200, method=replace(eg.DEFAULT, controls=()), space="rgb")
    assert found.psnr_rgb > plain.psnr_rgb


@pytest.mark.parametrize("factor", [1, 1000])
def test_a_retreat_returns_where_the_error_has_risen(factor):
    """To the set at which the optimiser started, with the rates times the factor."""
    watch = Watch(CONTROLS["Retreat"])
    method = replace(eg.DEFAULT, controls=(watch,)).at_rates(factor)
    start = eg.fit(picture(), COUNT, 0, space="rgb").gaussians
    eg.fit(picture(), COUNT, 20, method=method, space="rgb")
    [(_, before, after)] = watch.acts
    if factor == 1:
        assert after is before
    else:
        check_equal(after.gaussians, start.to_arrays())
        assert after.speed == 0.4


def test_each_image_of_a_batch_retreats_for_itself():
    """Images of a batch that diverges are fitted one by one: with the bits of single fits."""
    images = [PHOTO[:SIDE, :SIDE], np.full((SIDE, SIDE, 3), 0.3, np.float32)]
    method = replace(eg.DEFAULT.at_rates(30), controls=(CONTROLS["Retreat"],))
    options = {"gaussians": 40, "iterations": 45, "method": method}
    for row, image in zip(eg.fit_many(images, **options), images, strict=True):
        np.testing.assert_array_equal(row.result.image, eg.fit(image, **options).image)


def test_a_relocation_moves_those_of_least_worth_to_where_the_error_is():
    """A fifth, at most, by the squared error that the picture gains without one; others stay."""
    watch, _ = watched(replace(CONTROLS["Relocate"], every=20, share=0.2), steps=100)
    for before, after in watch.sets:
        rest = (before[np.arange(COUNT) != n] for n in range(COUNT))
        worth = [squared_error(g, picture()) for g in rest]
        stayed = stays(before, after)
        least = np.argsort(worth)[: COUNT // 4]  # lists that last miss some pairs
        assert stayed[np.setdiff1d(np.arange(COUNT), least)].all()
        assert 0 < (~stayed).sum() <= COUNT // 5
        assert len(after) == COUNT
    ratios = [squared_error(b, picture()) / squared_error(a, picture()) for a, b in watch.sets]
    assert ratios[0] < 1 and max(ratios) < 1.02  # near the end, what follows finds the colours


def test_noise_moves_all_gaussians_and_falls():
    """One seed gives one noise; colours stay; the last round has a fourteenth of the first."""
    (watch, _), (same, _), (other, _) = (
        watched(replace(CONTROLS["Perturb"], strength=0.02), seed=s) for s in (3, 3, 4)
    )
    moves = []
    for before, after in watch.sets:
        moved = (after.to_arrays()["mean"] - before.to_arrays()["mean"]) ** 2
        assert (before.factor.numpy() != after.factor.numpy()).any(axis=0).all()
        np.testing.assert_array_equal(after.color.numpy(), before.color.numpy())
        moves.append(np.sqrt(np.median(moved)))
    check_equal(same.sets[0][1], watch.sets[0][1].to_arrays())
    assert (other.sets[0][1].mean.numpy() != watch.sets[0][1].mean.numpy()).any()
    assert len(moves) == 14 and moves[-1] < 0.2 * moves[0]


def test_noise_is_what_the_image_can_bear():
    """The mean of each Gaussian adds a like error: faint ones move far, in their deviations."""
    watch, _ = watched(replace(CONTROLS["Perturb"], strength=0.3), PHOTO, 400, 1000)
    before, after = (g.to_arrays() for g in watch.sets[0])
    (a, b, c), (x, y) = before["factor"].T, (after["mean"] - before["mean"]).T
    amplitude = np.linalg.norm(before["color"], axis=1) / np.sqrt(a * c)
    added = np.hypot(a * x + b * y, c * y) * amplitude
    order = np.argsort(amplitude)
    faint, bright = added[order[50:200]], added[order[200:350]]  # the faintest have a bound
    assert 0.7 < np.median(faint) / np.median(bright) < 1.4
    assert amplitude[order[275]] > 2 * amplitude[order[125]]


@pytest.mark.parametrize("name", ["Redistribute", "Perturb", "Retreat"])
def test_controls_leave_levels_alone(name):
    watch = Watch(CONTROLS[name])
    eg.fit(picture(), [10, 30], 200, method=replace(eg.DEFAULT, controls=(watch,)))
    assert all(before is after for _, before, after in watch.acts)


@pytest.mark.slow
def test_levels_relocate_inside_themselves():
    """A tenth of each level, at most, before the same background."""
    watch = Watch(replace(CONTROLS["Relocate"], every=20))
    eg.fit(picture(), [20, 60], 80, method=replace(eg.DEFAULT, controls=(watch,)))
    changed = np.zeros(60, bool)
    for before, after in watch.sets:
        one, other = before.to_arrays(), after.to_arrays()
        moved = (one["mean"] != other["mean"]).any(axis=1)
        assert moved[:20].sum() <= 2 and moved[20:].sum() <= 4
        np.testing.assert_array_equal(one["background"], other["background"])
        changed |= moved
    assert changed[:20].any() and changed[20:].any()


# --- In a descent --------------------------------------------------------------------------------


def test_a_surplus_leaves_evenly():
    """More Gaussians after a redistribution, fewer after each round, in the end those asked for."""
    watch = Watch(replace(CONTROLS["Relocate"], every=5))
    method = often()
    controls = tuple(watch if c.phase == "moves" else c for c in method.controls[1:])
    found = eg.fit(picture(), COUNT, 100, method=replace(method, controls=controls))
    totals = [before.total for _, before, _ in watch.acts] + [watch.acts[-1][2].total]
    dropped = -np.diff(totals)
    assert totals[0] == COUNT < max(totals) <= 2 * COUNT and totals[-1] == COUNT
    assert dropped[2:].max() - dropped[2:].min() <= 1
    assert len(found.gaussians) == COUNT


def test_no_surplus_in_short_fits_and_dense_sets():
    for count, steps, largest in ((100, 600, 100), (100, 900, 190), (300, 900, 300)):
        fit = eg.fit(PHOTO, count, steps)
        most = max(row["gaussians"] for row in fit.trace)
        assert most == count if largest == count else count < most <= largest


def test_the_trace_has_a_row_at_each_of_its_steps():
    """Those of sets with a surplus too, which are never the result."""
    told = []
    found = eg.fit(picture(), COUNT, 200, method=often(), progress=lambda *a: told.append(a))
    assert len(found.gaussians) == COUNT
    numbers = {row["iteration"]: row["gaussians"] for row in found.trace}
    assert list(numbers) == [0, 10, 20, 50, 100, 200]
    assert numbers[100] > COUNT and numbers[0] == numbers[200] == COUNT
    best = max(row["psnr_ycbcr"] for row in found.trace if row["gaussians"] == COUNT)
    assert found.psnr_ycbcr == best
    assert [row["iteration"] for step, _, row in told if step == 50] == [50]


@pytest.mark.parametrize("step", [60, 130])
def test_an_interrupt_in_between_leaves_the_number_asked_for(step):
    """Amid the rounds, and just after the last: the best set with a surplus is pruned as well."""

    def stop(iteration, iterations, row):
        if iteration >= step:
            raise KeyboardInterrupt

    with pytest.raises(eg.Interrupted) as caught:
        eg.fit(PHOTO, COUNT, 200, progress=stop, method=often())
    result = caught.value.result
    assert len(result.gaussians) == COUNT
    assert result.trace[-1]["iteration"] == result.iterations == step
    best = max(row["psnr_ycbcr"] for row in result.trace if row["gaussians"] == COUNT)
    assert best >= result.trace[0]["psnr_ycbcr"]
    assert eg.psnr(result.image, PHOTO, "ycbcr") == pytest.approx(best, abs=1e-4)


class Every:
    """A control that changes nothing, at every step."""

    def steps(self, iterations):
        return range(iterations)

    def __call__(self, state, objective, step, iterations, key):
        return state


def test_a_control_is_called_with_the_state_of_its_step():
    """Looking at it changes nothing."""
    watch = Watch(Every())
    method = replace(eg.DEFAULT, controls=(watch,))
    found = eg.fit(picture(), 40, 30, method=method, seed=7, space="rgb")
    errors = [squared_error(before, picture()) for before, _ in watch.sets]
    assert len(errors) == 30 and errors[-1] < errors[0]
    plain = eg.fit(picture(), 40, 30, method=replace(method, controls=()), seed=7, space="rgb")
    np.testing.assert_array_equal(found.image, plain.image)


def steps_as_long_as_their_rates(iterations, *controls, **changed):
    """The sets before the steps of a fit by the signs of derivatives."""
    watch, adam = Watch(Every()), eg.DEFAULT.optimizer
    signs = replace(adam, beta_1=0.0, beta_2=0.0, epsilon=1e-12)
    method = replace(eg.DEFAULT, controls=(*controls, watch), optimizer=signs, decay=1.0, **changed)
    eg.fit(picture(), 100, iterations, method=method, space="rgb")
    return [before.to_arrays() for before, _ in watch.sets]


def test_rates_rise_after_a_control():
    """The optimiser starts anew, without momentum, and warms up."""
    silent = replace(CONTROLS["Perturb"], strength=0.0, every=8)
    sets = steps_as_long_as_their_rates(32, silent, rates={"color": 1e-5}, warm_up=4, solve_steps=0)
    colors = [arrays["color"].astype(float) for arrays in sets]
    moves = np.median(np.abs(np.diff(colors, axis=0)), axis=(1, 2)) / 1e-5
    first = min(silent.steps(32))
    assert 8 < first < 16
    for since in (0, first):
        np.testing.assert_allclose(moves[since : since + 5], [0.25, 0.5, 0.75, 1, 1], atol=0.02)


def test_rates_of_shapes_fall_with_the_colour():
    """By the root of its length, within bounds."""
    rates = {"mean": 1e-3, "color": 1e-5}
    before, after = steps_as_long_as_their_rates(2, rates=rates, warm_up=0, rate_exponent=0.5)
    a, _, c = before["factor"].T
    moves = np.abs(after["mean"] - before["mean"]).min(axis=1) * np.sqrt(a * c) / 1e-3
    length = np.linalg.norm(before["color"], axis=1)
    expected = np.clip(np.sqrt(length.mean() / length), 1 / 1.7, 1.7)
    assert np.median(np.abs(moves / expected - 1)) < 0.02

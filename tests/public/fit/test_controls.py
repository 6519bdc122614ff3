"""Controls: when each acts, what each does alone, and all of them in a descent."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.halves import SIDE, fitted, objective_of, picture, squared_error, ycbcr_psnr
from _helpers.sets import check_equal
from eigengs_dr.fitting.control import (
    Perturb,
    Redistribute,
    Relocate,
    Retreat,
    Surplus,
    round_steps,
)
from eigengs_dr.fitting.loop import Descent, descend, last, refine
from eigengs_dr.fitting.measure import Measured
from eigengs_dr.fitting.objective import Part
from eigengs_dr.fitting.state import begin

COUNT, STEPS = 30, 100


def often(every=5, share=1.0):
    """The default method with rounds in short descents too."""
    rounds = Surplus(share, every=every), Redistribute(), Relocate(every), Perturb(every=every)
    return replace(eg.DEFAULT, controls=(Retreat(), *rounds))


def placed(image=None, backend=None):
    return fitted(COUNT, backend, image)


# --- When they act -------------------------------------------------------------------------------


def test_rounds_end_after_two_thirds():
    assert round_steps(45, 100) == []
    assert round_steps(45, 140) == [46, 91]
    assert round_steps(45, 1000) == [round(650 * k / 14) for k in range(1, 15)]
    assert round_steps(45, 100_000)[-1] == 65_000
    assert round_steps(0, 1000) == []
    assert Relocate().steps(1000) == Perturb().steps(1000) == round_steps(45, 1000)


def test_redistribution_comes_after_a_tenth_of_a_short_descent():
    steps = (0, 99, 100, 150, 200, 100_000)
    assert [Redistribute().steps(n) for n in steps] == [(), (), (10,), (15,), (20,), (20,)]
    assert Redistribute(after=0).steps(1000) == ()


def test_how_large_a_surplus_is():
    assert Surplus(every=45).number(1000, 256 * 256, 600) == 0  # eight rounds
    assert Surplus(every=45).number(1000, 256 * 256, 800) == 500  # eleven
    assert Surplus(every=45).number(1000, 256 * 256, 90) == 0  # none
    assert Surplus(0.0).number(1000, 256 * 256, 980) == 0
    assert Surplus().number(5000, 256 * 256, 1000) == 0  # dense enough


# --- Each alone ----------------------------------------------------------------------------------


def acts(control, state, objective, step=0, iterations=1000, key=0):
    assert step in control.steps(iterations)
    return control(state, objective, step, iterations, key)


def test_a_surplus_is_a_number():
    gaussians, objective = placed()
    state = acts(Surplus(), begin(gaussians), objective)
    assert (state.count, state.surplus) == (COUNT, COUNT)
    assert state.gaussians is gaussians


def test_redistribution_places_all_anew():
    """With the surplus; less error is left than a placement by the image leaves."""
    gaussians, objective = fitted(150, image=eg.sample("coffee")[100:164, 200:264])
    state = replace(begin(gaussians), surplus=7)
    found = acts(Redistribute(), state, objective, 20)
    assert (found.total, found.count, found.moving, found.lists) == (157, 150, None, ())
    assert squared_error(found.gaussians, objective) < squared_error(gaussians, objective)


@pytest.mark.parametrize("what", [{"levels": (10,)}, {"part": Part(slice(0, 9), (slice(9),) * 2)}])
def test_levels_and_parts_are_not_placed_anew(what):
    gaussians, objective = placed()
    state = begin(gaussians)
    assert acts(Redistribute(), state, replace(objective, **what), 20) is state


def test_chosen_gaussians_stay_where_they_fit():
    """Where half of the set has no error, no redistribution is better; the surplus comes too."""
    gaussians, objective = fitted(150, image=eg.sample("coffee")[100:164, 200:264])
    fits = last(descend(objective, eg.DEFAULT, begin(gaussians), 300), gaussians)
    state = replace(begin(fits, chosen=True), surplus=7)
    found = acts(Redistribute(), state, objective, 20).gaussians
    assert len(found) == 157
    assert np.isin(fits.mean.numpy()[0], found.mean.numpy()[0]).mean() > 0.7


def test_a_retreat_returns_where_the_error_has_risen():
    """To the set at which the optimiser started, with the rates times the factor, once more."""
    gaussians, objective = placed()
    control, method = Retreat(), replace(eg.DEFAULT, controls=())
    assert control.steps(200) == [10, 20, 40, 80, 160]
    for factor, returns in ((1.0, False), (1000.0, True)):
        *_, state = descend(objective, method.at_rates(factor), begin(gaussians), 10)
        found = acts(control, state, objective, 10)
        assert (found is not state) == returns
        if returns:
            check_equal(found.gaussians, gaussians.to_arrays())
            assert found.speed == 0.4 and found.moving is None
            again = acts(control, replace(found, fixed=state.fixed), objective, 20)
            assert again.speed == 0.4  # its error is that of the start: it has not risen
    begun = begin(gaussians)
    assert acts(control, begun, objective, 10) is begun  # nothing has moved


def test_each_image_of_a_batch_retreats_for_itself():
    """Images of a batch that diverges are fitted one by one: with the bits of single fits."""
    images = [eg.sample("coffee")[100:132, 200:232], np.full((SIDE, SIDE, 3), 0.3, np.float32)]
    method = replace(eg.DEFAULT.at_rates(30), controls=(Retreat(),))
    options = {"gaussians": 40, "iterations": 45, "method": method}
    for row, image in zip(eg.fit_many(images, **options), images, strict=True):
        np.testing.assert_array_equal(row.result.image, eg.fit(image, **options).image)


def test_rates_that_are_too_high_are_lowered():
    """At default steps, half of what good rates gain is left, at least."""
    image = eg.sample("astronaut")[100:148, 200:248]
    good, high = (
        eg.fit(image, 100, method=eg.DEFAULT.at_rates(factor)).psnr_ycbcr for factor in (1, 8)
    )
    start = eg.fit(image, 100, 0).psnr_ycbcr
    assert high > start + 0.5 * (good - start)


def test_relocation_lets_the_surplus_go_evenly():
    """Over 14 rounds; the optimiser starts anew each time."""
    gaussians, objective = placed()
    control = Relocate(share=0.1)
    state, left = replace(begin(gaussians), count=10), []
    for step in control.steps(1000):
        state = acts(control, state, objective, step)
        left.append(state.total)
        assert (state.moving, state.lists) == (None, ())
    dropped = -np.diff([COUNT, *left])
    assert left[-1] == 10 and dropped.max() - dropped.min() <= 1
    squares = squared_error(gaussians, objective)
    first = acts(control, begin(gaussians), objective, control.steps(1000)[0])
    assert float(first.squares[0]) == pytest.approx(squares, rel=1e-4)


@pytest.mark.parametrize("own", [None, slice(5, 20)])
def test_noise_moves_all_own_gaussians(own):
    """One key and step give one noise; others give other noise; colours stay."""
    gaussians, objective = placed()
    if own:
        objective = replace(objective, part=Part(own, (slice(None), slice(None))))
    control, state = Perturb(), begin(gaussians)
    step, later = control.steps(1000)[:2]
    before = gaussians.to_arrays()
    one, same, other, next_one = (
        acts(control, state, objective, s, key=k).gaussians.to_arrays()
        for s, k in ((step, 3), (step, 3), (step, 4), (later, 3))
    )
    for name in ("mean", "factor"):
        np.testing.assert_array_equal(one[name], same[name])
        moved = (one[name] != before[name]).any(axis=1)
        np.testing.assert_array_equal(np.flatnonzero(moved), np.arange(COUNT)[own or slice(None)])
        assert (other[name] != one[name]).any() and (next_one[name] != one[name]).any()
    np.testing.assert_array_equal(one["color"], before["color"])


def test_noise_falls_from_round_to_round():
    """Linearly to a fourteenth, as the moves of the means show."""
    gaussians, objective = placed()
    control, lengths = Perturb(0.02), []
    for step in control.steps(1000):
        moves = [
            acts(control, begin(gaussians), objective, step, key=k).gaussians.mean - gaussians.mean
            for k in range(12)
        ]
        lengths.append(np.median([np.linalg.norm(m.numpy(), axis=0) for m in moves]))
    np.testing.assert_allclose(np.array(lengths) / lengths[0], np.linspace(1, 1 / 14, 14), atol=0.2)


def test_noise_does_not_depend_on_the_scale_of_weights():
    gaussians, _ = placed()
    found = []
    for factor in (None, 1e-3, 1e3):
        weight = None if factor is None else np.full((SIDE, SIDE), factor, np.float32)
        objective = objective_of(picture(), weight=weight)
        found.append(acts(Perturb(), begin(gaussians), objective, 46).gaussians.mean.numpy())
    np.testing.assert_allclose(found[1:], [found[0]] * 2, rtol=1e-4)


def test_with_levels_there_is_no_noise():
    gaussians, objective = placed()
    state = begin(gaussians)
    assert acts(Perturb(), state, replace(objective, levels=(10,)), 46) is state


# --- In a descent --------------------------------------------------------------------------------


def test_a_descent_ends_with_the_number_asked_for(backend):
    """As many before a redistribution, more after it, and fewer after each round."""
    gaussians, objective = placed(backend=backend)
    states = descend(objective, often(), begin(gaussians), STEPS)
    counts = [state.total for state in states]
    more = Surplus(every=5).number(COUNT, SIDE * SIDE, STEPS)
    assert more > 0
    assert set(counts[:10]) == {COUNT} and counts[10] in range(COUNT + 1, COUNT + more + 1)
    assert (np.diff(counts[10:]) <= 0).all() and counts[-1] == COUNT


def test_a_recorded_step_serves_all_counts(backend):
    """Without recording the descent is the same, although Gaussians come and go."""
    controls = Surplus(every=3), Redistribute(after=5), Relocate(3), Perturb(every=3)
    method, ends, counts = replace(eg.DEFAULT, controls=controls), [], set()
    for recorded in (True, False):
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, recorded):
            gaussians, objective = placed(backend=backend)
            for state in descend(objective, method, begin(gaussians), 60, part=range(42)):
                counts.add(state.total)
            ends.append(state.gaussians.to_arrays())
    assert len(counts) > 4
    for name, values in ends[0].items():
        np.testing.assert_array_equal(ends[1][name], values)


def test_a_fit_with_a_surplus_after_fits_of_other_sizes():
    """Programs that were recorded for fewer Gaussians are not replayed for more."""
    image = eg.sample("coffee")[:128, :128]
    for count in (60, 250):
        found = eg.fit(image, count, iterations=200, method=often(10))
        assert len(found.gaussians) == count
        assert found.psnr_ycbcr > found.trace[0]["psnr_ycbcr"] + 2


def scored(image, row=None):
    """A score by the psnr_ycbcr of RGB images."""
    return lambda gaussians: [Measured({"psnr_ycbcr": ycbcr_psnr(gaussians, image)})]


def test_the_trace_has_a_row_at_each_of_its_steps():
    """Those of sets with a surplus too, which are never the result."""
    told, image = [], picture()
    gaussians, objective = placed(image)
    descent = Descent(
        objective, often(), scored(image), progress=lambda *a: told.append((a[0], a[2]))
    )
    [found] = refine(descent, begin(gaussians), 200)
    assert len(found.gaussians) == COUNT
    numbers = {row["iteration"]: row["gaussians"] for row in found.trace}
    assert list(numbers) == [0, 10, 20, 50, 100, 200]
    assert numbers[100] > COUNT and numbers[0] == numbers[200] == COUNT
    assert found.row == max(
        (row for row in found.trace if row["gaussians"] == COUNT),
        key=lambda row: row["psnr_ycbcr"],
    )
    assert dict(told)[50]["iteration"] == 50  # progress goes on


@pytest.mark.parametrize("color", ["rgb", "linear"])
def test_an_interrupt_in_between_leaves_the_number_asked_for(color):
    """The last row measures the last step without the surplus."""
    image = eg.sample("coffee")[:64, :64]

    def stop(iteration, iterations, row):
        if iteration == 60:
            raise KeyboardInterrupt

    with pytest.raises(eg.Interrupted) as caught:
        eg.fit(image, COUNT, 200, space=color, progress=stop, method=often())
    result = caught.value.result
    assert len(result.gaussians) == COUNT
    assert result.trace[-1]["iteration"] == result.iterations == 60
    best = max(row["psnr_ycbcr"] for row in result.trace if row["gaussians"] == COUNT)
    assert best >= result.trace[0]["psnr_ycbcr"]
    assert eg.psnr(result.image, image, "ycbcr") == pytest.approx(best, abs=1e-4)


def test_an_interrupt_after_the_last_round_keeps_the_best_set_before_it():
    """Just after noise the last step is poor; the best set with a surplus is pruned as well."""
    image = picture()
    last_round = round_steps(5, 200)[-1]

    def stop(iteration, iterations, row):
        if iteration >= last_round:
            raise KeyboardInterrupt

    gaussians, objective = placed(image)
    descent = Descent(objective, often(), scored(image), progress=stop)
    [found] = refine(descent, begin(gaussians), 200)
    rows = [row for row in found.trace if row["gaussians"] == COUNT]
    *first, best, last = (row["iteration"] for row in rows)
    assert first == [0, 10, 20] and best in (50, 100) and last == last_round
    assert len(found.gaussians) == COUNT
    psnrs = [row["psnr_ycbcr"] for row in rows]
    assert ycbcr_psnr(found.gaussians, image) == pytest.approx(max(psnrs), abs=1e-4)


@pytest.mark.parametrize("count", [1, 9])
def test_sets_too_small_for_a_share_keep_their_gaussians(count):
    assert len(eg.fit(eg.sample("coffee")[:32, :32], count, 200).gaussians) == count

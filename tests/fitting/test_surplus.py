"""More Gaussians than asked for, which leave in the course of a descent."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.halves import SIDE, fitted, picture, relocate, squared_error
from eigengs_dr.fitting.density_control import removal_cost
from eigengs_dr.fitting.descent import descend
from eigengs_dr.fitting.options import PRESETS, FitOptions
from eigengs_dr.fitting.refine import refine
from eigengs_dr.fitting.schedule import Relocation, relocations, surplus_for
from eigengs_dr.fitting.start import initialize
from eigengs_dr.raster.render import picture_of

SCHEDULE = replace(PRESETS["default"].schedule, relocate_every=15)
COUNT, STEPS = 30, 100


def start_of(image, backend=None):
    return initialize(image, FitOptions(gaussians=COUNT, init="adaptive", backend=backend))


@pytest.mark.parametrize(("share", "dropped", "left"), [(0.2, 0, 60), (0.2, 5, 55), (0.1, 9, 51)])
def test_the_least_useful_are_dropped(share, dropped, left):
    """The others that leave move; if more are dropped than the share says, none moves."""
    start, target = fitted()
    leaving = max(int(share * 60), dropped)
    least = np.argsort(removal_cost(start.gaussians, target), kind="stable")[:leaving]
    before = start.gaussians.to_arrays()["mean"]
    found = relocate(start.gaussians, Relocation(share, dropped=dropped), target)
    mean = found.to_arrays()["mean"]
    assert len(found) == left
    stayed = (mean[:, None] == before[None]).all(axis=2).any(axis=0)
    assert stayed[np.setdiff1d(np.arange(60), least)].all()
    places = leaving - dropped
    assert stayed[least].sum() <= places  # those without a better place
    rest = relocate(start.gaussians, Relocation(0.0, dropped=leaving), target)
    gains = squared_error(rest, target) - squared_error(found, target)
    assert gains > 0 if places else gains == 0


def test_noise_is_that_of_a_set_that_keeps_all():
    """Dropping changes no draw of another Gaussian."""
    start, target = fitted()
    kept, fewer = (
        relocate(start.gaussians, Relocation(0.1, 0.5, 3, dropped), target).to_arrays()["mean"]
        for dropped in (0, 6)
    )
    assert (fewer[:, None] == kept[None]).all(axis=2).any(axis=1).all()


@pytest.mark.parametrize("surplus", [0, 1, 13, 14, 500])
def test_rounds_drop_all_of_it_evenly(surplus):
    rounds = relocations(PRESETS["default"].schedule, 980, surplus)
    dropped = [move.dropped for move in rounds.values()]
    assert len(dropped) == 14 and sum(dropped) == surplus
    assert max(dropped) - min(dropped) <= 1


def test_how_many_of_short_descents():
    schedule = replace(SCHEDULE, relocate_every=45, surplus=1.0)
    assert surplus_for(schedule, 1000, 256 * 256, 280) == 400  # four rounds
    assert surplus_for(schedule, 1000, 256 * 256, 90) == 0  # none
    assert surplus_for(replace(schedule, surplus=0.0), 1000, 256 * 256, 980) == 0


def test_a_descent_ends_with_the_number_asked_for(backend):
    """As many in the first phase, more after it, and fewer after each round."""
    counts = [len(g) for g in descend(start_of(picture(), backend), SCHEDULE, STEPS)]
    more = surplus_for(SCHEDULE, COUNT, SIDE * SIDE, STEPS - 10)
    assert more > 0
    assert set(counts[:11]) == {COUNT} and counts[11] == COUNT + more
    assert (np.diff(counts[11:]) <= 0).all() and counts[-1] == COUNT


def test_a_recorded_step_serves_all_counts(backend):
    """The program is recorded with the largest set; without recording the descent is the same."""
    ends = []
    for recorded in (True, False):
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, recorded):
            *_, last = descend(start_of(picture(), backend), SCHEDULE, STEPS)
            ends.append(last.to_arrays())
    for name, values in ends[0].items():
        np.testing.assert_array_equal(ends[1][name], values)


def test_the_trace_shows_sets_of_the_number_asked_for():
    told, image = [], picture()
    found = refine(
        start_of(image), image, SCHEDULE, 200, progress=lambda *a: told.append((a[0], a[2]))
    )
    assert len(found.gaussians) == COUNT
    assert [row["iteration"] for row in found.trace] == [0, 10, 20, 200]
    assert dict(told)[50]["iteration"] == 50  # progress goes on


@pytest.mark.parametrize("color", ["rgb", "linear"])
def test_an_interrupt_in_between_leaves_the_number_asked_for(color, monkeypatch):
    """The last row measures the last step without the surplus."""
    image = eg.sample("coffee")[:64, :64]
    method = replace(PRESETS["default"], schedule=SCHEDULE)
    monkeypatch.setitem(PRESETS, "default", method)

    def stop(iteration, iterations, row):
        if iteration == 60:
            raise KeyboardInterrupt

    with pytest.raises(eg.FitInterrupted) as caught:
        eg.fit(image, COUNT, 200, space=color, progress=stop)
    result = caught.value.result
    assert len(result.gaussians) == COUNT
    assert result.trace[-1]["iteration"] == result.iterations == 60
    best = max(row["psnr_ycbcr"] for row in result.trace)
    assert best >= result.trace[0]["psnr_ycbcr"]
    assert eg.psnr(result.image, image, "ycbcr") == pytest.approx(best, abs=1e-4)


def test_an_interrupt_after_the_last_round_keeps_the_best_set_before_it():
    """Just after noise the last step is poor; the best set with a surplus is pruned as well."""
    image = picture()

    def stop(iteration, iterations, row):
        if iteration == 140:  # the last relocation was at 134
            raise KeyboardInterrupt

    found = refine(start_of(image), image, SCHEDULE, 200, progress=stop)
    *first, best, last = (row["iteration"] for row in found.trace)
    assert first == [0, 10, 20] and best in (50, 100) and last == 140
    assert len(found.gaussians) == COUNT
    psnrs = [row["psnr_ycbcr"] for row in found.trace]
    shown = eg.psnr(picture_of(found.gaussians), image, "ycbcr")
    assert shown == pytest.approx(max(psnrs), abs=1e-4)

"""Methods: numbers out of range are refused where they are given; runs compare them by values."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from eigengs_dr.fitting.coarse import Agreeing, Coarse
from eigengs_dr.fitting.control import Perturb, Redistribute, Relocate, Retreat, Surplus
from eigengs_dr.fitting.place import Grid
from eigengs_dr.fitting.state import Adam
from eigengs_dr.paper.adan import Adan

PHOTO = eg.sample("coffee")[:32, :32]

FIELDS = [
    *((eg.DEFAULT, name) for name in ["warm_up", "decay", "drift", "rate_exponent", "solve_steps"]),
    *((eg.DEFAULT, name) for name in ["cutoff", "average"]),
    *((Surplus(), name) for name in ["share", "max_density", "every"]),
    *((Redistribute(), name) for name in ["after", "solve_steps"]),
    *((Relocate(), name) for name in ["every", "share"]),
    *((Perturb(), name) for name in ["strength", "every"]),
    *((Retreat(), name) for name in ["rise", "factor", "first"]),
    *((Adam(), name) for name in ["beta_1", "beta_2", "epsilon"]),
    *((Agreeing(), name) for name in ["memory", "gain", "first", "least", "floor", "epsilon"]),
    *((Coarse(), name) for name in ["share", "max_steps", "rate", "decay", "fit_steps"]),
    (Adan(), "epsilon"),
    (eg.Goal(30.0), "psnr"),
]


@pytest.mark.parametrize("value", [np.nan, np.inf, -1, True, "2", [3]], ids=repr)
@pytest.mark.parametrize(("record", "name"), FIELDS, ids=lambda v: getattr(v, "__name__", None))
def test_numbers_out_of_range_are_refused_in_a_line(record, name, value):
    is_whole = type(getattr(record, name)) is int
    kind = ValueError if type(value) in ((int,) if is_whole else (int, float)) else TypeError
    with pytest.raises(kind, match="is ") as caught:
        replace(record, **{name: value})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("rate", [np.nan, np.inf, 0, -1, True, "2"])
def test_rates_out_of_range_are_refused(rate):
    with pytest.raises(ValueError, match="each must be above 0 and finite"):
        replace(eg.DEFAULT, rates={"mean": rate})


def test_a_small_exponent_of_rates_is_next_to_none():
    found = [eg.fit(PHOTO, 40, 20, method=replace(eg.DEFAULT, rate_exponent=e)) for e in (5e-4, 0)]
    assert found[0].psnr_rgb == pytest.approx(found[1].psnr_rgb, abs=0.1)


def test_no_surplus_in_short_fits():
    short, long = ({"gaussians": 100, "iterations": n} for n in (600, 900))
    photo = eg.sample("coffee")[:64, :64]
    assert max(row["gaussians"] for row in eg.fit(photo, **short).trace) == 100
    assert max(row["gaussians"] for row in eg.fit(photo, **long).trace) > 100


def test_the_seed_moves_the_second_placement():
    """Without noise, the sets just after it differ."""
    method = replace(eg.DEFAULT, controls=(Redistribute(),))
    places = [eg.fit(PHOTO, 40, 100, method=method, seed=s).gaussians.mean.numpy() for s in (0, 1)]
    first = replace(eg.DEFAULT, place=Grid(), controls=())
    assert not np.array_equal(*places)
    same = [eg.fit(PHOTO, 40, 20, method=first, seed=s).gaussians.mean.numpy() for s in (0, 1)]
    np.testing.assert_array_equal(*same)  # a grid has no seed


class Mine(Grid):
    """A placement with settings of its own, whose repr has an address."""

    __repr__ = object.__repr__

    def __init__(self, width=1.0):
        object.__setattr__(self, "width", width)


def test_runs_compare_methods_by_values(tmp_path):
    def fitted(place, **changed):
        method = replace(eg.DEFAULT, place=place, **changed)
        [row] = eg.fit_many([PHOTO], tmp_path, gaussians=20, iterations=2, method=method)
        return row.status

    rates = {**eg.DEFAULT.rates, "color": 0.1}
    assert fitted(Mine()) == "done" and fitted(Mine()) == "skipped"
    for words, place, changed in (
        (r"method.place.width 1.0 instead of 2.0; use", Mine(2.0), {}),
        (r"method.place \S*Mine instead of \S*Grid; use", Grid(), {}),
        (r"method.cutoff 3.0 instead of 4.0; use", Mine(), {"cutoff": 4.0}),
        (r"method.rates.color 0.0115 instead of 0.1; use", Mine(), {"rates": rates}),
    ):
        with pytest.raises(ValueError, match=words) as caught:
            fitted(place, **changed)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("steps", [1, 5, 15])
def test_a_loss_without_a_derivative_says_so(steps):
    """At its least value, 0, a root has none."""

    def nothing(picture, step):
        return dr.sqrt(dr.mean(dr.square(picture - picture), axis=None))

    with pytest.raises(ValueError, match=r"loss: .*not its derivative at steps? 0.*dr.sqrt"):
        eg.fit(PHOTO, 20, steps, loss=nothing)

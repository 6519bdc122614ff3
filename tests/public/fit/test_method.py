"""Methods as values; controls and placements of a user's own."""

from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.halves import fitted, squared_error
from _helpers.photos import coffee
from _helpers.waves import METHODS
from eigengs_dr.fitting.control import Perturb, Redistribute, Relocate, Retreat, Surplus
from eigengs_dr.fitting.method import Method, Model
from eigengs_dr.fitting.place import Adaptive, Grid, gaussians_at
from eigengs_dr.fitting.state import Adam, Relative
from eigengs_dr.paper.adan import Adan
from eigengs_dr.paper.eigengs import EIGENGS, EigenGSMethod
from eigengs_dr.paper.gaussianimage import GAUSSIANIMAGE, Cholesky, RandomColors

NAMES = {
    value.__name__: value
    for value in (
        *(Method, Adaptive, Surplus, Redistribute, Relocate, Perturb, Retreat, Adam, Relative),
        *(Adan, Cholesky, EigenGSMethod, RandomColors, Grid),
    )
}


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_the_repr_is_the_method(method):
    """One line for each part."""
    text = repr(method)
    assert eval(text, NAMES) == method
    assert len(text.splitlines()) == len(fields(method)) + 2


def test_a_method_is_a_value():
    changed = replace(eg.DEFAULT, cutoff=4.0)
    assert changed != eg.DEFAULT and replace(changed, cutoff=eg.DEFAULT.cutoff) == eg.DEFAULT
    assert isinstance(EIGENGS, Method) and EIGENGS.needs_model and not GAUSSIANIMAGE.needs_model
    with pytest.raises(AttributeError):
        eg.DEFAULT.cutoff = 4.0


def test_controls_of_a_method():
    assert eg.DEFAULT.in_phase("grows") == [Surplus()]
    less = eg.DEFAULT.without("grows", "shakes")
    assert less.in_phase("grows") == []
    assert less.controls == (Retreat(), Redistribute(), Relocate())
    assert GAUSSIANIMAGE.in_phase("places") == []


def test_a_control_of_ones_own_may_say_its_phase():
    """Without one it acts in every descent."""
    own, beside = Shrink(60), eg.DEFAULT.without("grows", "places", "moves", "shakes")
    assert replace(eg.DEFAULT, controls=(own,)).without("moves").controls == (own,)
    assert beside.controls == (Retreat(),)

    class Mover(Shrink):
        phase = "moves"

    method = replace(eg.DEFAULT, controls=(Mover(60), *beside.controls))
    assert method.steps_in("moves", 100) == {60} and method.first_phase(100) == 0
    assert method.without("moves").controls == beside.controls


def test_rates_times_a_factor():
    assert eg.DEFAULT.at_rates(0.5).rates == {k: v / 2 for k, v in eg.DEFAULT.rates.items()}


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"cutoff": 0}, r"Method: cutoff is 0.0; it must be in \(0, 12\]"),
        ({"cutoff": 13}, r"cutoff is 13.0; it must be in \(0, 12\]"),
        ({"cutoff": np.nan}, "cutoff is nan"),
        ({"solve_steps": -1}, r"solve_steps is -1; it must be in \[0, inf\)"),
        ({"controls": (Surplus(),)}, "controls: a Surplus leaves by a Relocate that comes as ofte"),
        ({"controls": (Surplus(), Relocate(every=90))}, "add one, or leave the Surplus out"),
        ({"rates": {}}, "rates are {}; each must be above 0"),
        ({"rates": {"mean": 0.1, "color": 0}}, "each must be above 0"),
        ({"rates": {"mean": np.nan}}, "each must be above 0"),
    ],
)
def test_bad_values_are_refused(changed, words):
    with pytest.raises(ValueError, match=words) as error:
        replace(eg.DEFAULT, **changed)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"place": "random"}, "place holds 'random', which lacks what a Placement has"),
        ({"place": Grid}, "place holds <class .*Grid'>"),
        ({"controls": None}, "controls is None; give a tuple of controls"),
        ({"controls": (print,)}, "controls holds .*see eigengs_dr.fitting.control.Control"),
        ({"optimizer": 3}, "optimizer holds 3"),
        ({"solve_steps": 2.5}, "solve_steps is 2.5; it must be a whole number"),
        ({"coordinates": Adaptive()}, r"coordinates holds Adaptive\(\)"),
    ],
)
def test_parts_are_checked(changed, words):
    with pytest.raises(TypeError, match=words):
        replace(eg.DEFAULT, **changed)


def test_methods_are_keys():
    assert {eg.DEFAULT: 1}[replace(eg.DEFAULT, rates=dict(eg.DEFAULT.rates))] == 1


@pytest.mark.parametrize("share", [-0.1, 1.1, np.nan])
def test_shares_are_checked(share):
    with pytest.raises(ValueError, match=r"Relocate: share is .*; it must be in \[0, 1\]"):
        Relocate(share=share)


def test_what_is_a_model():
    assert not isinstance(fitted()[0], Model)
    assert isinstance(eg.EigenGS.load("natural"), Model)


@pytest.mark.parametrize("rates", [{"color": 0.01}, {"mean": 0.3, "color": 0.01}])
def test_variables_without_a_rate_stay(rates):
    method = replace(eg.DEFAULT, rates=rates, controls=())
    start, found = (eg.fit(coffee(32), 40, n, method=method) for n in (0, 30))
    before, after = (r.gaussians.to_arrays() for r in (start, found))
    for name in ("mean", "factor"):
        same = np.allclose(before[name], after[name], rtol=1e-5)
        assert same == (name not in rates)
    assert found.psnr_ycbcr > start.psnr_ycbcr


@dataclass(frozen=True)
class Prune:
    """A control that removes Gaussians, and says so or not."""

    says: bool

    def steps(self, iterations):
        return range(5, iterations, 10)

    def __call__(self, state, objective, step, iterations, key):
        pruned = state.replaced(state.gaussians[np.arange(state.total - 3)])
        return replace(pruned, count=pruned.total) if self.says else pruned


def test_a_control_says_how_many_gaussians_it_leaves():
    image, method = coffee(32), replace(eg.DEFAULT, controls=(Prune(True),))
    found = eg.fit(image, 40, 30, method=method)
    assert len(found.gaussians) == 31 and found.iterations == 30
    assert [row["gaussians"] for row in found.trace] == [40, 37, 34, 31]
    with pytest.raises(ValueError, match=r"left 37 Gaussians, but the count of the state is 40"):
        eg.fit(image, 40, 30, method=replace(method, controls=(Prune(False),)))


def test_a_control_returns_a_state():
    class Nothing(Prune):
        def __call__(self, *state):
            return None

    with pytest.raises(TypeError, match="returned None; a control returns the state"):
        eg.fit(coffee(32), 40, 30, method=replace(eg.DEFAULT, controls=(Nothing(True),)))


# --- A control and a placement of one's own -----------------------------------------------------


@dataclass(frozen=True)
class Mirror:
    """Places pairs of round Gaussians that mirror each other."""

    sigma: float = 3.0
    has_colors = False

    def __call__(self, objective, count, cutoff, seed):
        width, height = objective.size
        left = np.random.default_rng(seed).uniform(0, (width / 2, height), (count // 2, 2))
        right = np.array([width, 0]) + left * np.array([-1, 1])
        factor = np.tile([1 / self.sigma, 0, 1 / self.sigma], (2 * (count // 2), 1))
        return gaussians_at(objective, np.concatenate([left, right]), factor, cutoff)


@dataclass(frozen=True)
class Shrink:
    """Shrinks all Gaussians once."""

    step: int
    factor: float = 1.5

    def steps(self, iterations):
        return [self.step]

    def __call__(self, state, objective, step, iterations, key):
        gaussians = state.gaussians
        return state.replaced(replace(gaussians, factor=gaussians.factor * self.factor))


def test_a_placement_of_ones_own():
    image = coffee(32)
    method = replace(eg.DEFAULT, place=Mirror(), controls=())
    start, one, other = (
        eg.fit(image, 40, n, method=method, seed=seed) for n, seed in ((0, 1), (150, 1), (0, 2))
    )
    mean = start.gaussians.to_arrays()["mean"]
    np.testing.assert_allclose(mean[:20, 0] + mean[20:, 0], 32, rtol=1e-5)
    assert one.psnr_ycbcr > start.psnr_ycbcr + 1
    assert not np.array_equal(other.gaussians.to_arrays()["mean"], mean)


@pytest.mark.parametrize("others", [(), eg.DEFAULT.controls], ids=["alone", "beside"])
def test_a_control_of_ones_own(others):
    """Its step has the sets that it makes, and the optimiser starts anew."""
    seen = []
    method = replace(eg.DEFAULT, controls=(*others, Shrink(60)))
    found = eg.fit(coffee(32), 40, 120, method=method, progress=lambda *a: seen.append(a[0]))
    assert len(found.gaussians) == 40 and found.psnr_ycbcr > found.trace[0]["psnr_ycbcr"]
    plain = eg.fit(coffee(32), 40, 120, method=replace(method, controls=others))
    assert not np.array_equal(found.image, plain.image)


def test_a_control_is_called_with_the_state_of_its_step():
    calls = []

    class Watch:
        def steps(self, iterations):
            return range(0, iterations, 10)

        def __call__(self, state, objective, step, iterations, key):
            calls.append((step, iterations, key, squared_error(state.gaussians, objective)))
            return state

    method = replace(eg.DEFAULT, controls=(Watch(),))
    found = eg.fit(coffee(32), 40, 50, method=method, seed=7)
    assert [c[:3] for c in calls] == [(n, 50, 7) for n in range(0, 50, 10)]
    errors = [c[3] for c in calls]
    assert errors[-1] < errors[0]
    plain = eg.fit(coffee(32), 40, 50, method=replace(method, controls=()), seed=7)
    np.testing.assert_array_equal(found.image, plain.image)  # looking changes nothing

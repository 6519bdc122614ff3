"""Methods as values: their parts, what they refuse, and parts of a user's own."""

from dataclasses import dataclass, fields, replace

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.errors import complaint
from _helpers.photos import coffee
from _helpers.waves import CONTROLS, METHODS, picture
from eigengs_dr.paper import adan

PHOTO = coffee(32)
GAUSSIANIMAGE, EIGENGS = METHODS["gaussianimage"], METHODS["eigengs"]
ADAM, AGREEING = eg.DEFAULT.optimizer, eg.COARSE_TO_FINE.place.optimizer

PARTS = (*METHODS.values(), *CONTROLS.values(), ADAM, AGREEING, GAUSSIANIMAGE.optimizer)
PARTS += tuple(getattr(m, part) for m in METHODS.values() for part in ("place", "coordinates"))


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_the_repr_is_the_method(method):
    """One line for each part."""
    assert eval(repr(method), {type(part).__name__: type(part) for part in PARTS}) == method
    assert len(repr(method).splitlines()) == len(fields(method)) + 2


def test_a_method_is_a_value():
    changed = replace(eg.DEFAULT, cutoff=4.0)
    assert changed != eg.DEFAULT and replace(changed, cutoff=eg.DEFAULT.cutoff) == eg.DEFAULT
    assert isinstance(EIGENGS, eg.Method) and EIGENGS.needs_model and not GAUSSIANIMAGE.needs_model
    assert {eg.DEFAULT: 1}[replace(eg.DEFAULT, rates=dict(eg.DEFAULT.rates))] == 1
    assert eg.DEFAULT.at_rates(0.5).rates == {k: v / 2 for k, v in eg.DEFAULT.rates.items()}
    with pytest.raises(AttributeError):
        eg.DEFAULT.cutoff = 4.0


def test_phases_of_controls():
    """A control of one's own may say its phase; without one it acts in every descent."""
    assert eg.DEFAULT.in_phase("densify") == [CONTROLS["Surplus"]]
    less = eg.DEFAULT.without("densify", "perturb")
    assert less.controls == tuple(CONTROLS[k] for k in ("Backtrack", "Redistribute", "Relocate"))
    assert GAUSSIANIMAGE.in_phase("redistribute") == []
    method = replace(eg.DEFAULT, controls=(Shrink(60), Moving(60)))
    assert method.steps_in("relocate", 100) == {60} and method.first_phase(100) == 0
    assert method.without("relocate").controls == (Shrink(60),)


# --- What is refused ----------------------------------------------------------------------------

NUMBERS = {
    eg.DEFAULT: "warm_up decay drift rate_exponent solve_steps cutoff average",
    CONTROLS["Surplus"]: "share max_density every",
    CONTROLS["Redistribute"]: "after solve_steps",
    CONTROLS["Relocate"]: "every share",
    CONTROLS["Perturb"]: "strength every",
    CONTROLS["Backtrack"]: "rise factor first",
    ADAM: "beta_1 beta_2 epsilon",
    AGREEING: "memory gain first least floor fall epsilon",
    eg.Coarse(): "share max_steps rate decay fit_steps",
    adan.Adan(): "epsilon",
    eg.Goal(30.0): "psnr",
}
FIELDS = [(part, name) for part, names in NUMBERS.items() for name in names.split()]


@pytest.mark.parametrize("value", [np.nan, np.inf, -1, True, "2", [3], None], ids=repr)
@pytest.mark.parametrize(("part", "name"), FIELDS, ids=lambda v: getattr(v, "__name__", None))
def test_numbers_out_of_range_are_refused_in_a_line(part, name, value):
    is_whole = type(getattr(part, name)) is int
    kind = ValueError if type(value) in ((int,) if is_whole else (int, float)) else TypeError
    assert "is " in complaint(kind, replace, part, **{name: value})


@pytest.mark.parametrize(
    ("part", "changed", "words"),
    [
        (eg.DEFAULT, {"cutoff": 0}, "Method: cutoff is 0.0; it must be in (0, 12]"),
        (eg.DEFAULT, {"solve_steps": -1}, "solve_steps is -1; it must be in [0, inf)"),
        (eg.DEFAULT, {"controls": (CONTROLS["Surplus"],)}, "controls: a Surplus leaves by a Reloc"),
        (
            eg.DEFAULT,
            {"controls": (CONTROLS["Surplus"], replace(CONTROLS["Relocate"], every=90))},
            "add one, or leave the Surplus out",
        ),
        (eg.DEFAULT, {"rates": {}}, "rates are {}; each must be above 0"),
        (eg.DEFAULT, {"rates": {"mean": np.inf}}, "each must be above 0 and finite"),
        (CONTROLS["Relocate"], {"share": 1.1}, "Relocate: share is 1.1; it must be in [0, 1]"),
        (ADAM, {"beta_1": 1.0}, "Adam: beta_1 is 1.0; "),
        (adan.Adan(), {"betas": (0.9, -0.1, 0.9)}, "betas"),
        (AGREEING, {"least": 0.0}, "least"),
    ],
)
def test_bad_values_are_refused(part, changed, words):
    assert words in complaint(ValueError, replace, part, **changed)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"place": "random"}, "place is 'random', which lacks what a Placement has"),
        ({"controls": None}, "controls is None; give a tuple of controls"),
        ({"controls": (print,)}, "a control is .*see eigengs_dr.fitting.control.Control"),
        ({"optimizer": 3}, "optimizer is 3, which"),
        ({"coordinates": eg.Coarse()}, "coordinates is of the type Coarse, which"),
    ],
)
def test_parts_are_checked(changed, words):
    with pytest.raises(TypeError, match=words):
        replace(eg.DEFAULT, **changed)


# --- Optimisers and rates -----------------------------------------------------------------------


def adam_by_hand(x, gradient, rate, steps, betas, epsilon=1e-12):
    """Algorithm 1 of the paper, with its epsilon after the debiasing of the second moment."""
    m, v = np.zeros_like(x), np.zeros_like(x)
    for t in range(1, steps + 1):
        g = gradient(x)
        m = betas[0] * m + (1 - betas[0]) * g
        v = betas[1] * v + (1 - betas[1]) * g**2
        scale = rate * np.sqrt(1 - betas[1] ** t) / (1 - betas[0] ** t)
        x = x - scale * m / (np.sqrt(v) + epsilon)
        yield x


def adan_by_hand(x, gradient, rate, steps, betas, epsilon=1e-8):
    """Algorithm 1 of the paper, its betas subtracted from one as in its authors' code."""
    m, v, n = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
    last = gradient(x)
    for t in range(1, steps + 1):
        g = gradient(x)
        m = betas[0] * m + (1 - betas[0]) * g
        v = betas[1] * v + (1 - betas[1]) * (g - last)
        n = betas[2] * n + (1 - betas[2]) * (g + betas[1] * (g - last)) ** 2
        m_hat, v_hat, n_hat = (
            average / (1 - beta**t) for average, beta in zip((m, v, n), betas, strict=True)
        )
        x = x - rate * (m_hat + betas[1] * v_hat) / (np.sqrt(n_hat) + epsilon)
        last = g
        yield x


@pytest.mark.parametrize(
    ("optimizer", "by_hand", "betas"),
    [
        (replace(ADAM, beta_1=0.9, beta_2=0.99, epsilon=1e-12), adam_by_hand, (0.9, 0.99)),
        (adan.Adan(), adan_by_hand, (0.98, 0.92, 0.99)),
    ],
    ids=["adam", "adan"],
)
def test_steps_are_those_of_the_paper(optimizer, by_hand, betas, backend):
    """Of a variable whose gradient is always 0 too: it rests."""
    Float, start = getattr(dr, backend).ad.Float64, np.array([1.0, -2, 0.5, 0])
    value, path = Float(start), []
    moments = optimizer.start(value)
    for time in range(1, 31):
        gradient = value * value * value + 3 * dr.sin(value)
        numbers = dr.opaque(Float, 0.1), dr.opaque(Float, time)
        value, moments = optimizer.step(value, gradient, moments, *numbers)
        dr.eval(value, moments)
        path.append(value.numpy().copy())
    expected = [*by_hand(start, lambda x: x**3 + 3 * np.sin(x), 0.1, 30, betas)]
    np.testing.assert_allclose(path, expected, rtol=0, atol=1e-10 * np.ptp(expected))


@pytest.mark.parametrize("places", [False, True])
def test_rates_fall_by_half_a_cosine(places):
    """Which ends near what `decay` leaves; another one before a redistribution."""
    method = replace(eg.DEFAULT, decay=0.25)
    method = method if places else method.without("redistribute")
    lengths = (20, 180) if places else (200,)
    left = [0.25 + 0.75 * 0.5 * (1 + np.cos(np.pi * np.arange(n) / n)) for n in lengths]
    np.testing.assert_allclose(method.rate_factors(200), np.concatenate(left), rtol=1e-6)


@pytest.mark.parametrize("rates", [{"color": 0.01}, {"mean": 0.3, "color": 0.01}])
def test_variables_without_a_rate_stay(rates):
    method = replace(eg.DEFAULT, rates=rates, controls=())
    start, found = (eg.fit(PHOTO, 40, n, method=method) for n in (0, 30))
    before, after = (r.gaussians.to_arrays() for r in (start, found))
    for name in ("mean", "factor"):
        same = np.allclose(before[name], after[name], rtol=1e-5)
        assert same == (name not in rates)
    assert found.psnr_ycbcr > start.psnr_ycbcr


@pytest.mark.parametrize("factor", [pytest.param(10, marks=pytest.mark.slow), 1000])
@pytest.mark.parametrize("name", ["default", "gaussianimage"])
def test_rates_far_too_high(name, factor):
    """Nothing but finite numbers, and never worse than the start."""
    result = eg.fit(picture(), 40, 60, method=METHODS[name].at_rates(factor))
    assert np.isfinite([row["psnr_ycbcr"] for row in result.trace]).all()
    assert all(np.isfinite(v).all() for v in result.gaussians.to_arrays().values())
    assert result.psnr_ycbcr >= result.trace[0]["psnr_ycbcr"]


@pytest.mark.parametrize(
    "count", [300, pytest.param(8, marks=pytest.mark.slow)], ids=["many", "large"]
)
def test_lists_that_last_are_as_good_as_lists_of_every_step(count):
    """A drift of 0 builds lists in every step. Rounding changes most fits by 0.03 dB or less."""
    method, gains = replace(eg.DEFAULT, controls=()), []
    for seed in range(5):
        top, left = np.random.default_rng(seed).integers(0, (208, 408))
        image = eg.sample("coffee")[top : top + 128 : 2, left : left + 128 : 2]
        lasting, fresh = (
            eg.fit(image, count, 40, method=m) for m in (method, replace(method, drift=0.0))
        )
        gains.append(lasting.psnr_ycbcr - fresh.psnr_ycbcr)
    assert abs(np.median(gains)) < 0.03


# --- A placement and a control of one's own -----------------------------------------------------


@dataclass(frozen=True)
class Mirror:
    """Places pairs of round Gaussians that mirror each other."""

    sigma: float = 3.0
    has_colors = False

    def __call__(self, objective, count, cutoff, seed):
        width, height = objective.size
        left = np.random.default_rng(seed).uniform(0, (width / 2, height), (count // 2, 2))
        mean = np.concatenate([left, np.array([width, 0]) + left * np.array([-1, 1])])
        factor = np.tile([1 / self.sigma, 0, 1 / self.sigma], (len(mean), 1))
        kind = {"size": objective.size, "space": objective.space, "cutoff": cutoff}
        return eg.Gaussians.from_arrays(mean, factor, np.zeros((len(mean), 3)), **kind)


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


class Moving(Shrink):
    """Says its phase."""

    phase = "relocate"


@dataclass(frozen=True)
class Prune:
    """Removes Gaussians, and says so or not."""

    says: bool

    def steps(self, iterations):
        return range(5, iterations, 10)

    def __call__(self, state, objective, step, iterations, key):
        pruned = state.replaced(state.gaussians[np.arange(state.total - 3)])
        return replace(pruned, count=pruned.total) if self.says else pruned


class Forgets(Prune):
    """Returns nothing."""

    def __call__(self, *arguments):
        return None


def test_a_placement_of_ones_own():
    """It is not placed anew, and has no surplus, but gains from relocation."""
    method = replace(eg.DEFAULT, place=Mirror())
    start, one, other = (
        eg.fit(PHOTO, 40, n, method=method, seed=seed) for n, seed in ((0, 1), (150, 1), (0, 2))
    )
    mean = start.gaussians.to_arrays()["mean"]
    np.testing.assert_allclose(mean[:20, 0] + mean[20:, 0], 32, rtol=1e-5)
    assert one.psnr_ycbcr > start.psnr_ycbcr + 1
    assert not np.array_equal(other.gaussians.to_arrays()["mean"], mean)
    plain = eg.fit(PHOTO, 40, 150, method=method.without("densify", "redistribute"), seed=1)
    np.testing.assert_array_equal(one.image, plain.image)
    image, moves = eg.sample("coffee")[100:164, 200:264], ("densify", "relocate", "perturb")
    moved, left = (eg.fit(image, 200, 600, method=m) for m in (method, method.without(*moves)))
    assert moved.psnr_rgb > left.psnr_rgb + 0.3


@pytest.mark.parametrize("others", [(), eg.DEFAULT.controls], ids=["alone", "beside"])
def test_a_control_of_ones_own(others):
    """Its step has the sets that it makes, and the optimiser starts anew."""
    method = replace(eg.DEFAULT, controls=(*others, Shrink(60)))
    found = eg.fit(PHOTO, 40, 120, method=method)
    assert len(found.gaussians) == 40 and found.psnr_ycbcr > found.trace[0]["psnr_ycbcr"]
    plain = eg.fit(PHOTO, 40, 120, method=replace(method, controls=others))
    assert not np.array_equal(found.image, plain.image)


def test_a_control_says_how_many_gaussians_it_leaves():
    method = replace(eg.DEFAULT, controls=(Prune(True),))
    found = eg.fit(PHOTO, 40, 30, method=method)
    assert len(found.gaussians) == 31 and found.iterations == 30
    assert [row["gaussians"] for row in found.trace] == [40, 37, 34, 31]
    with pytest.raises(ValueError, match=r"left 37 Gaussians, but the count of the state is 40"):
        eg.fit(PHOTO, 40, 30, method=replace(method, controls=(Prune(False),)))
    with pytest.raises(TypeError, match="returned None; a control returns the state"):
        eg.fit(PHOTO, 40, 30, method=replace(method, controls=(Forgets(True),)))

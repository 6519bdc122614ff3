"""Fits of losses: an image places as in a fit of it; without an image, texels come first."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest
from drjit.opt import Adam

import eigengs_dr as eg
from _helpers.photos import coffee
from _helpers.sets import random_scene

SIDE = 32
IMAGE = coffee(SIDE)
FREE = {"size": (SIDE, SIDE)}
given = pytest.mark.parametrize("given", [{"image": IMAGE}, FREE], ids=["image", "free"])


def squares(picture, step=0):
    return dr.mean(dr.square(picture - type(picture)(IMAGE)), axis=None)


def masked(picture, weight):
    """A mask of 0 leaves a derivative of 0."""
    mask = type(picture)(np.full((SIDE, SIDE, 1), weight, np.float32))
    return dr.mean(dr.square(picture - type(picture)(IMAGE)) * mask, axis=None)


def absolute(picture, step=0):
    return dr.mean(dr.abs(picture - type(picture)(IMAGE)), axis=None)


def fit(loss, gaussians=50, iterations=60, space="rgb", **options):
    return eg.fit(gaussians=gaussians, iterations=iterations, space=space, loss=loss, **options)


# --- With an image ------------------------------------------------------------------------------


def test_the_squared_error_is_that_of_a_fit():
    """In the median of five images: other roundings lead elsewhere."""
    differences = []
    for row, column in ((60, 60), (200, 300), (30, 120), (150, 90), (100, 200)):
        image = eg.sample("coffee")[row : row + 48, column : column + 48]

        def loss(picture, step, image=image):
            return dr.mean(dr.square(picture - type(picture)(image)), axis=None)

        plain, found = (fit(f, 200, 500, image=image) for f in (None, loss))
        differences.append(found.psnr_rgb - plain.psnr_rgb)
    assert np.median(differences) == pytest.approx(0, abs=0.1)
    assert found.loss == pytest.approx(float(np.mean((found.image - image) ** 2)), rel=1e-3)
    assert [row["iteration"] for row in found.trace] == [row["iteration"] for row in plain.trace]
    assert f"loss={found.loss:.4g}" in repr(found)


def test_another_loss_is_lower_than_after_a_fit():
    plain, found = (fit(f, 100, 150, image=IMAGE) for f in (None, absolute))
    assert found.loss < np.abs(plain.image - IMAGE).mean() < found.trace[0]["loss"]
    again = fit(absolute, 100, 150, image=IMAGE)
    np.testing.assert_array_equal(found.image, again.image)  # one seed gives one result


@given
def test_its_unit_does_not_matter(given):
    """A power of two even gives equal bits."""
    found = [
        fit(lambda picture, step, unit=unit: masked(picture, unit), 50, 120, **given).image
        for unit in (1, 1e6, 2.0**-30)
    ]
    psnrs = [eg.psnr(image, IMAGE) for image in found]
    assert max(psnrs) - min(psnrs) < 0.3
    np.testing.assert_array_equal(found[-1], found[0])


def test_a_target_takes_fewer_for_a_higher_loss():
    few, many = (fit(eg.Loss(squares, target=t), None, image=IMAGE) for t in (1e-3, 3e-4))
    assert (few.stopped, many.stopped) == ("met", "met")
    assert len(few.gaussians) < len(many.gaussians)
    assert few.loss <= 1e-3 and many.loss <= 3e-4


@pytest.mark.slow
def test_maps_are_given_by_name():
    maps = {name: IMAGE[..., k : k + 1] for k, name in enumerate(("roughness", "metal", "ao"))}

    def loss(pictures, step):
        errors = [pictures[name] - type(pictures[name])(image) for name, image in maps.items()]
        return sum(dr.mean(dr.square(error), axis=None) for error in errors)

    found = fit(loss, 50, image=maps, space=None)
    assert found.loss < found.trace[0]["loss"] and found.maps["roughness"]["psnr_rgb"] > 25
    found = fit(eg.Loss(loss, bounds=(0, 1)), 50, 120, dict.fromkeys(maps, "data"), **FREE)
    assert [m.name for m in found.gaussians.maps] == list(maps)
    assert found.image["ao"].shape == (SIDE, SIDE, 1)
    assert np.mean((found.image["ao"] - maps["ao"]) ** 2) < 1e-3
    with pytest.raises(TypeError, match=r"take each by its name, such as pictures\['roughness'\]"):
        fit(lambda maps, step: dr.mean(maps, axis=None), 10, 4, dict.fromkeys(maps, "data"), **FREE)


# --- Without an image ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "space",
    [
        "rgb",
        pytest.param("ycbcr", marks=pytest.mark.slow),
        pytest.param("linear", marks=pytest.mark.slow),
        "log",
    ],
)
def test_no_image_is_needed(space):
    """In every space the picture is what `render` gives."""
    found = fit(squares, 100, 120, space, **FREE)
    drawn = eg.render(found.gaussians).numpy()
    assert np.mean((drawn - IMAGE) ** 2) == pytest.approx(found.loss, rel=1e-3)
    assert found.loss < 2e-4 and np.isnan(found.psnr_rgb)
    assert found.gaussians.space == space and found.iterations == 120
    assert [row["iteration"] for row in found.trace][:2] == [60, 60]


def test_a_weight_says_where_the_picture_matters():
    """Most of the loss lies in a quarter of the picture; the texels' picture does not say so."""
    weight = np.full((SIDE, SIDE, 1), 0.001, np.float32)
    weight[:16, :16] = 1
    # Half of the steps, so that the Gaussians have settled.
    options = FREE | {"method": replace(eg.COARSE_TO_FINE, place=eg.Coarse(share=0.5))}
    plain, weighed = (
        fit(lambda picture, step: masked(picture, weight), 50, 100, weight=w, **options).loss
        for w in (None, weight)
    )
    assert weighed < 0.85 * plain


def test_a_half_that_a_loss_ignores_looks_like_the_other():
    """Instead of the grey that a fit starts from."""
    red, half = np.float32([0.8, 0.2, 0.1]), np.s_[:, : SIDE // 2]

    def left(picture, step=0):
        return dr.mean(dr.square(picture[half] - type(picture)(red)), axis=None)

    result = fit(left, 50, 120, **FREE)
    np.testing.assert_allclose(result.image[:, SIDE // 2 + 4 :].mean((0, 1)), red, atol=0.05)


def test_texels_of_photos_end_once_their_rate_falls():
    """A loss says by its pixels that steps see parts of the picture, as photos do."""
    kinds = eg.Coarse().optimizer, replace(eg.Coarse().optimizer, fall=0.0)
    methods = [replace(eg.COARSE_TO_FINE, place=eg.Coarse(optimizer=kind)) for kind in kinds]
    photos = eg.Loss(squares, pixels=10 * SIDE**2)
    early, late = (fit(photos, iterations=100, method=method, **FREE) for method in methods)
    assert 25 <= early.trace[0]["iteration"] < late.trace[0]["iteration"] == 60
    assert early.iterations == late.iterations == 100 and early.loss < 2e-4
    assert fit(squares, iterations=100, **FREE).trace[0]["iteration"] == 60


def test_the_space_of_a_loss_is_a_default():
    loss = eg.Loss(squares, space="log")
    assert fit(loss, 100, 4, space=None, **FREE).gaussians.space == "log"
    assert fit(loss, 100, 4, space="rgb", **FREE).gaussians.space == "rgb"


def test_a_start_takes_the_place_of_texels():
    """A loss sees what `render` draws of it."""
    first = fit(squares, **FREE)
    then = fit(squares, None, space=None, start=first, **FREE)
    assert len(then.gaussians) == 50 and then.gaussians.space == "rgb"
    assert then.loss < first.loss and then.trace[0]["loss"] == pytest.approx(first.loss, rel=1e-3)
    seen = []

    def loss(picture, step):
        seen.append(picture.numpy())
        return squares(picture)

    fit(loss, None, 1, space=None, start=first, **FREE)
    np.testing.assert_allclose(seen[0], eg.render(first).numpy(), atol=2e-6)


def test_the_average_of_sets_is_quieter_than_the_last():
    """With noisy derivatives, at equal rates."""

    def noisy(picture, step):
        noise = np.random.default_rng(step).normal(0, 0.5, IMAGE.shape).astype(np.float32)
        return dr.mean(dr.square(picture - type(picture)(IMAGE + noise)), axis=None)

    start = fit(None, 50, 50, image=IMAGE).gaussians
    method = eg.COARSE_TO_FINE.at_rates(3)
    mean, last = (
        fit(noisy, None, 100, start=start, method=m, **FREE).image
        for m in (method, replace(method, average=0.0))
    )
    assert np.mean((mean - IMAGE) ** 2) < 0.8 * np.mean((last - IMAGE) ** 2)
    with pytest.raises(ValueError, match="average is"):
        replace(eg.DEFAULT, average=0.5)


# --- When it is called --------------------------------------------------------------------------


def test_the_step_is_the_number_of_steps_taken():
    """Rows of the trace ask for step 0; controls for the next step."""
    seen = []

    def loss(picture, step):
        seen.append(step)
        return squares(picture)

    fit(loss, 50, 40, image=IMAGE)
    assert sorted(set(seen)) == list(range(40)) and len(seen) > 45
    asked = [step for step in seen if step]
    assert asked == sorted(asked)


def test_rows_between_the_ends_call_no_loss():
    """Their loss is the mean of the steps since the row before; the ends measure their sets."""
    calls = []

    def counted(picture, step):
        calls.append(step)
        return squares(picture)

    found = fit(counted, 50, 100, **FREE)
    assert len(calls) == 100 + 2 and calls.count(0) == 1 + 2
    assert found.loss == pytest.approx(squares(eg.render(found.gaussians)).array[0], rel=1e-5)
    losses = [row["loss"] for row in found.trace]
    assert losses[0] > losses[-1] and len(losses) == 5  # texels; 0, 10, 20 and 40 steps after
    for number in (0, 1):  # no step of Gaussians: there is no mean
        texels, first, *_ = fit(squares, 50, number, **FREE).trace
        assert texels["loss"] > 0.01 and first["loss"] > 0.01


def test_the_last_set_counts_without_a_judge():
    """The loss of the first step does not compare with that of another one."""
    found = fit(lambda p, step: masked(p, 1.0 if step else 0.1), 50, 40, **FREE)
    assert found.loss == found.trace[-1]["loss"]


@pytest.mark.parametrize("kind", [float, np.asarray, lambda x: int(1e6 * x)])
def test_a_judge_chooses_the_best_set_by_any_number(kind):
    loss = eg.Loss(squares, judge=lambda p: kind(np.mean((p.numpy() - IMAGE) ** 2)))
    found = fit(loss, 20, 4, image=IMAGE)
    assert found.loss == pytest.approx(kind(np.mean((found.image - IMAGE) ** 2)), rel=1e-4)
    assert found.loss == min(row["loss"] for row in found.trace)


def test_bounds_keep_sums_inside():
    """Twice the photo would be best; what the loss sees is clipped."""
    seen = []

    def loss(picture, step):
        seen.extend([dr.min(picture, axis=None).array[0], dr.max(picture, axis=None).array[0]])
        return squares(0.5 * picture)

    free = fit(loss, 50, 120, **FREE).image
    assert free.max() > 1.5 and max(seen) > 1.5
    seen.clear()
    held = fit(eg.Loss(loss, bounds=(0, 1)), 50, 120, **FREE).image
    assert min(seen) >= 0 and max(seen) <= 1
    assert held.min() > -0.05 and 0.9 < held.max() < 1.1


# --- Derivatives --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plain:
    """Gradient descent."""

    def start(self, value):
        return ()

    def step(self, value, gradient, moments, rate, time):
        return value - rate * gradient, moments


@dataclass(frozen=True)
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


def descent(name, rate):
    """A method whose only step follows the gradient by one parameter of a set."""
    plain = replace(eg.COARSE_TO_FINE, optimizer=Plain(), coordinates=Fields(), solve_steps=0)
    return replace(plain, rates={name: rate}, warm_up=0, average=0.0, cutoff=9.0)


CASES = [("rgb", "mean"), ("rgb", "factor"), ("log", "color")]
CASES += [pytest.param("ycbcr", "color", marks=pytest.mark.slow)]


@pytest.mark.parametrize(("space", "name"), CASES)
def test_the_derivative_is_a_finite_difference(space, name, backend):
    """In double precision, through what the picture shows; in a unit of its own."""
    scene = random_scene()._replace(background=np.full(3, 0.7))
    scene = scene._replace(color=0.1 * scene.color, mean=np.clip(scene.mean, 1, 16))
    target = np.random.default_rng(5).uniform(0.2, 0.8, (17, 22, 3))

    def loss(picture, step=0):
        assert dr.type_v(picture) == dr.VarType.Float64
        error = dr.square(picture - type(picture)(target)) * (1 + picture)
        return dr.sum(error, axis=None)

    def value(**changed):
        moved = replace(scene._replace(**changed).on(backend, 64, space), cutoff=9.0)
        return loss(eg.render(moved)).numpy().item()

    start, before = replace(scene.on(backend, 64, space), cutoff=9.0), getattr(scene, name)
    options = {"start": start, "method": descent(name, 1e-3), "size": scene.size}
    moved = fit(loss, None, 1, space, **options).gaussians.to_arrays()[name]
    generator, slopes = np.random.default_rng(2), []
    for _ in range(3):
        direction = generator.normal(size=before.shape)
        up, down = (value(**{name: before + s * 1e-5 * direction}) for s in (1, -1))
        slopes.append(((before - moved) * direction).sum() / (up - down))
    np.testing.assert_allclose(slopes, slopes[0], rtol=1e-4)
    assert slopes[0] > 0


def test_parameters_of_the_user_step_along():
    """A gain of which the picture knows nothing; other gradients and arrays stay as they are."""
    kind = dr.llvm.ad.Float
    gain = Adam(lr=0.02, params={"gain": kind(0.5)})
    other, held, image = kind(2), kind(3), IMAGE.copy()
    dr.enable_grad(other)
    dr.set_grad(other, 7)

    def loss(picture, step):
        fixed = dr.mean(dr.square(held * 0.2 - other * gain["gain"] * 0.3))
        return squares(picture) + fixed

    fit(eg.Loss(loss, parameters=gain), 50, 100, image=image, backend="llvm")
    assert gain["gain"][0] == pytest.approx(1, abs=0.02)
    assert dr.grad(other)[0] == 7 and dr.grad_enabled(other) and held[0] == 3
    np.testing.assert_array_equal(image, IMAGE)


def dropped(picture, weight):
    """A weight of 0 leaves a number without a derivative."""
    return weight * squares(picture)


@pytest.mark.parametrize("weighed", [dropped, masked])
def test_a_step_without_a_derivative_moves_nothing(weighed):
    """Lists of Gaussians are built at each step here."""
    steady = replace(eg.DEFAULT, controls=(), decay=1.0, drift=0.01)
    loss = eg.Loss(lambda p, s: weighed(p, 0.0 if s in (6, 7, 14) else 1.0), judge=squares)
    rested = fit(loss, 50, 15, image=IMAGE, method=steady).image
    plain = fit(squares, 50, 12, image=IMAGE, method=steady).image
    np.testing.assert_allclose(rested, plain, atol=1e-5)


def test_a_loss_needs_a_derivative_at_some_step():
    """But at its least value, 0, there is none."""
    frozen = dr.freeze(lambda picture, wanted: dr.mean(dr.square(picture - wanted), axis=None))
    for loss in (
        lambda p, s: frozen(p, type(p)(IMAGE)),
        lambda p, s: squares(dr.detach(p)),
    ):
        with pytest.raises(ValueError, match=r"not depend on the picture at any step.*dr\.freeze"):
            fit(loss, 50, 8, image=IMAGE)
    met = fit(lambda p, s: dr.mean(dr.maximum(dr.square(p) - 9, 0), axis=None), 50, 8, **FREE)
    assert met.loss == 0 and met.stopped == "iterations"


# --- Mistakes -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("loss", "message"),
    [
        (lambda p, s: dr.square(p), "array of shape .* dr.mean"),
        (lambda p, s: float(np.mean(p.numpy())), "does not depend on the picture"),
        (lambda p, s: squares(p) * (np.nan if s == 3 else 1), "nan at steps 1-9"),
        (lambda p, s: squares(p) / 0, "its value is inf for a picture"),
        (lambda p, s: squares(p) + dr.mean(dr.sqrt(p - p)), "derivative at steps 0 and 10; dr.sq"),
        (eg.Loss(squares, judge=lambda p: p.array[0] * np.nan), "the judge is nan"),
    ],
)
def test_what_is_no_loss_ends_in_one_line(loss, message):
    with pytest.raises(ValueError, match=message) as error:
        fit(loss, 50, 30, image=IMAGE)
    assert "\n" not in str(error.value)


SQUARES = {"loss": squares, "size": (8, 8)}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"loss": squares}, "needs an image, or a loss and the size"),
        (SQUARES | {"target_psnr": 30}, "no PSNR"),
        (SQUARES | {"size": (8.0, 8.0)}, r"give \(width, height\) in whole pixels"),
        (SQUARES | {"gaussians": [2, 4]}, "levels are for the squared error"),
        (SQUARES | {"weight": np.ones((8, 9))}, "9x8 pixels, but size is"),
        (SQUARES | {"weight": np.ones((8, 8, 2))}, "2 channels, but the"),
        (
            {"image": IMAGE, "target_psnr": 20, "loss": eg.Loss(squares, target=1e-4)},
            "target_psnr and loss.target exclude each other",
        ),
        ({"image": IMAGE, "size": (8, 8)}, "size is for a loss without an image"),
    ],
)
def test_options_that_do_not_fit_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        eg.fit(**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bounds": (1, 0)}, "smaller"),
        ({"bounds": (0, np.inf)}, "give two numbers"),
        ({"target": 0}, "above 0"),
        ({"pixels": 0}, "pixels is 0; it must be at least 1"),
        ({"function": eg.Loss(squares)}, r"is a Loss; change one by dataclasses\.replace"),
        ({"function": 3}, "no function"),
        ({"function": lambda p: squares(p)}, r"<lambda>\(p\) is called with \(picture, step\)"),
        ({"function": dr.freeze(squares)}, "function is frozen by"),
        ({"judge": lambda p, s: 0.0}, r"judge <lambda>\(p, s\) is called with \(picture\)"),
        ({"target": "x"}, "target is 'x'; it must be a number"),
        ({"parameters": SimpleNamespace(step=lambda: None)}, "give an optimiser of"),  # of PyTorch
    ],
)
def test_parts_that_do_not_fit_are_refused(options, message):
    kind = ValueError if {"bounds", "target", "pixels"} & options.keys() else TypeError
    with pytest.raises(TypeError if options.get("target") == "x" else kind, match=message):
        eg.Loss(**{"function": squares, **options})
    assert eg.Loss(squares, bounds=np.array([0, 1])).bounds == (0, 1)


# --- Interruptions ------------------------------------------------------------------------------


STOPS = {"first": 0, "texels": 2, "later": 13}
"""Steps at which a loss ends a fit of 20, in half of them texels without an image."""


@given
@pytest.mark.parametrize("target", [None, pytest.param(1e-4, marks=pytest.mark.slow)])
@pytest.mark.parametrize("stop", [*STOPS, "judge"])
def test_a_loss_or_a_judge_may_end_the_fit(stop, target, given):
    """The best set so far is there, also if the judge measures no more."""
    judged = []

    def loss(picture, step):
        if step >= STOPS.get(stop, 99):
            raise KeyboardInterrupt
        return squares(picture)

    def judge(picture):
        judged.append(picture)
        if stop == "judge" and len(judged) > 1:
            raise KeyboardInterrupt
        return squares(picture)

    with pytest.raises(eg.Interrupted) as error:
        fit(eg.Loss(loss, judge=judge, target=target), None if target else 30, 20, **given)
    result = error.value.result
    assert result.stopped == "interrupted" and result.image.shape == IMAGE.shape
    assert target or len(result.gaussians) == 30
    assert result.iterations <= max(20, 2 * STOPS.get(stop, 20))


@given
@pytest.mark.parametrize("mine", [StopIteration("mine"), RuntimeError("mine")], ids=repr)
def test_other_errors_pass_as_they_are(mine, given):
    def loss(picture, step):
        raise mine

    with pytest.raises(type(mine)) as error:
        fit(loss, 30, 20, **given)
    assert error.value is mine


def test_an_operation_of_a_loss_may_end_the_fit():
    """Dr.Jit wraps the error, as that of a network of PyTorch."""

    class Ends(dr.CustomOp):
        def eval(self, picture):
            raise KeyboardInterrupt

    def loss(picture, step):
        return squares(dr.custom(Ends, picture) if step == 3 else picture)

    with pytest.raises(eg.Interrupted) as error:
        fit(loss, 20, 10, image=IMAGE)
    assert error.value.result.iterations == 3

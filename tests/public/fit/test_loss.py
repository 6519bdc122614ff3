"""Fits of losses: an image places as in a fit of it; without an image, texels come first."""

from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest
from drjit.opt import Adam

import eigengs_dr as eg
from eigengs_dr.backend.arrays import _types, types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.coarse import Coarse, enlarge, fill_unseen, shrink, texel_levels, texel_sums
from eigengs_dr.fitting.loss import LossObjective
from eigengs_dr.fitting.objective import Channels, Pixels, Target
from eigengs_dr.image.space import RGB, Affine, space_of

SIDE = 48
TYPES = types_in(select("llvm"))
IMAGE = eg.sample("coffee")[100 : 100 + SIDE, 200 : 200 + SIDE]


def squares(picture, step=0):
    return dr.mean(dr.square(picture - type(picture)(IMAGE)), axis=None)


def absolute(picture, step=0):
    return dr.mean(dr.abs(picture - type(picture)(IMAGE)), axis=None)


def test_the_squared_error_is_that_of_a_fit():
    """In the mean of three images: other roundings lead elsewhere."""
    differences = []
    for row, column in ((60, 60), (200, 300), (100, 200)):
        image = eg.sample("coffee")[row : row + SIDE, column : column + SIDE]

        def loss(picture, step, image=image):
            return dr.mean(dr.square(picture - type(picture)(image)), axis=None)

        fit, found = (eg.fit(image, 200, 500, space="rgb", loss=f) for f in (None, loss))
        differences.append(found.psnr_rgb - fit.psnr_rgb)
    assert np.mean(differences) == pytest.approx(0, abs=0.1)
    assert found.loss == pytest.approx(float(np.mean((found.image - IMAGE) ** 2)), rel=1e-3)
    assert [row["iteration"] for row in found.trace] == [row["iteration"] for row in fit.trace]
    assert f"loss={found.loss:.4g}" in repr(found)


def test_another_loss_is_lower_than_after_a_fit():
    fit = eg.fit(IMAGE, 200, 200, space="rgb")
    found = eg.fit(IMAGE, 200, 200, space="rgb", loss=absolute)
    assert found.loss < np.abs(fit.image - IMAGE).mean() < found.trace[0]["loss"]


def test_ssim_is_higher_than_after_a_fit():
    def loss(picture, step):
        return absolute(picture) + 0.2 * (1 - eg.ssim(picture, IMAGE))

    fit = eg.fit(IMAGE, 100, 200)
    found = eg.fit(IMAGE, 100, 200, loss=loss)
    assert eg.ssim(found.image, IMAGE) > eg.ssim(fit.image, IMAGE)
    assert found.psnr_rgb > fit.psnr_rgb - 1.5


@pytest.mark.parametrize("free", [False, True])
def test_its_unit_does_not_matter(free):
    """A power of two even gives equal bits."""
    given = {"size": (SIDE, SIDE)} if free else {"image": IMAGE}
    options = {**given, "gaussians": 144, "iterations": 120, "space": "rgb"}
    images = [
        eg.fit(**options, loss=lambda p, s, f=f: f * squares(p)).image for f in (1, 1e6, 2.0**-30)
    ]
    psnrs = [eg.psnr(image, IMAGE) for image in images]
    assert max(psnrs) - min(psnrs) < 0.3
    np.testing.assert_array_equal(images[-1], images[0])


def test_one_seed_gives_one_result():
    one, other = (eg.fit(IMAGE, 100, 150, loss=absolute).image for _ in range(2))
    np.testing.assert_array_equal(one, other)


def test_a_mask_frees_gaussians_for_the_rest():
    mask = np.zeros((SIDE, SIDE, 1), np.float32)
    mask[:, : SIDE // 2] = 1

    def loss(picture, step):
        weight = type(picture)(mask)
        error = dr.square(picture - type(picture)(IMAGE)) * weight
        return dr.sum(error, axis=None) / (3 * dr.sum(weight, axis=None))

    found = eg.fit(IMAGE, 100, 300, loss=loss)
    plain = eg.fit(IMAGE, 100, 300)
    half = np.s_[:, : SIDE // 2]
    assert eg.psnr(found.image[half], IMAGE[half]) > eg.psnr(plain.image[half], IMAGE[half]) + 1


@pytest.mark.parametrize("given", [{"image": IMAGE}, {"size": (SIDE, SIDE)}], ids=["image", "free"])
def test_a_target_takes_fewer_for_a_higher_loss(given):
    few, many = (
        eg.fit(**given, iterations=100, space="rgb", loss=eg.Loss(squares, target=t))
        for t in (1e-3, 3e-4)
    )
    assert (few.stopped, many.stopped) == ("met", "met")
    assert len(few.gaussians) < len(many.gaussians)
    assert few.loss <= 1e-3 and many.loss <= 3e-4


def test_maps_are_given_by_name():
    rough = IMAGE[..., :1]

    def loss(pictures, step):
        light, data = pictures["albedo"], pictures["rough"]
        assert light.shape == (SIDE, SIDE, 3) and data.shape == (SIDE, SIDE, 1)
        return dr.mean(dr.square(data - type(data)(rough)), axis=None) + dr.mean(
            dr.square(light - type(light)(IMAGE)), axis=None
        )

    maps = {"albedo": eg.Map(IMAGE, "linear"), "rough": rough}
    found = eg.fit(maps, 150, 150, loss=loss)
    assert found.loss < found.trace[0]["loss"] and found.maps["rough"]["psnr_rgb"] > 25
    found = eg.fit(
        loss=eg.Loss(loss, bounds=(0, 1)),
        size=(SIDE, SIDE),
        gaussians=150,
        iterations=150,
        space={"albedo": "linear", "rough": "data"},
    )
    assert [m.name for m in found.gaussians.maps] == ["albedo", "rough"]
    assert found.image["rough"].shape == (SIDE, SIDE, 1)
    assert np.mean((found.image["rough"] - rough) ** 2) < 1e-3


@pytest.mark.parametrize("space", ["rgb", "ycbcr", "linear", "log"])
def test_no_image_is_needed(space):
    """In every space the picture is what `render` gives."""
    found = eg.fit(loss=squares, size=(SIDE, SIDE), gaussians=200, iterations=200, space=space)
    drawn = eg.render(found.gaussians).numpy()
    assert np.mean((drawn - IMAGE) ** 2) == pytest.approx(found.loss, rel=1e-3)
    assert found.loss < 2e-4 and np.isnan(found.psnr_rgb)
    assert found.gaussians.space == space and found.iterations == 200
    assert [row["iteration"] for row in found.trace][:2] == [60, 60]


def test_a_weight_says_where_the_picture_matters():
    """Most of the loss lies in a quarter of the picture; the texels' picture does not say so."""
    weight = np.full((SIDE, SIDE, 1), 0.001, np.float32)
    weight[: SIDE // 2, : SIDE // 2] = 1
    image = eg.sample("coffee")[60 : 60 + SIDE, 60 : 60 + SIDE]

    def loss(picture, step):
        return dr.mean(dr.square(picture - type(picture)(image)) * type(picture)(weight), axis=None)

    asked = {"loss": loss, "size": (SIDE, SIDE), "gaussians": 100, "iterations": 100}
    plain, weighed = (eg.fit(**asked, space="rgb", weight=w).loss for w in (None, weight))
    assert weighed < 0.85 * plain


def test_the_space_of_a_loss_is_a_default():
    loss = eg.Loss(squares, space="rgb")
    asked = {"loss": loss, "size": (SIDE, SIDE), "gaussians": 50, "iterations": 4}
    assert eg.fit(**asked).gaussians.space == "rgb"
    assert eg.fit(**asked, space="linear").gaussians.space == "linear"


def test_a_start_takes_the_place_of_texels():
    first = eg.fit(loss=squares, size=(SIDE, SIDE), gaussians=100, iterations=60, space="rgb")
    then = eg.fit(loss=squares, size=(SIDE, SIDE), start=first, iterations=60)
    assert len(then.gaussians) == 100 and then.gaussians.space == "rgb"
    assert then.loss < first.loss and then.trace[0]["loss"] == pytest.approx(first.loss, rel=1e-3)


def test_double_precision_by_a_double_start():
    rows = eg.fit(IMAGE, 100, 0, space="rgb").gaussians.to_arrays()
    kinds = []

    def loss(picture, step):
        kinds.append(dr.type_v(picture))
        return squares(picture)

    start = eg.Gaussians.from_arrays(**rows, size=(SIDE, SIDE), space="rgb", dtype=np.float64)
    found = eg.fit(loss=loss, size=(SIDE, SIDE), start=start, iterations=30)
    assert set(kinds) == {dr.VarType.Float64} and found.loss < found.trace[0]["loss"]


def test_the_last_set_counts_without_a_judge():
    """The loss of the first step does not compare with that of another one."""

    def loss(picture, step):
        return (1 if step else 0.1) * squares(picture)

    found = eg.fit(loss=loss, size=(SIDE, SIDE), gaussians=50, iterations=40, space="rgb")
    assert found.loss == found.trace[-1]["loss"]


def test_bounds_keep_sums_inside():
    """Twice the photo would be best; what the loss sees is clipped."""
    seen = []

    def loss(picture, step):
        seen.extend([dr.min(picture, axis=None).array[0], dr.max(picture, axis=None).array[0]])
        return squares(0.5 * picture)

    options = {"size": (SIDE, SIDE), "gaussians": 100, "iterations": 200, "space": "rgb"}
    free = eg.fit(loss=loss, **options).image
    assert free.max() > 1.5 and max(seen) > 1.5
    seen.clear()
    held = eg.fit(loss=eg.Loss(loss, bounds=(0, 1)), **options).image
    assert min(seen) >= 0 and max(seen) <= 1
    assert held.min() > -0.05 and 0.9 < held.max() < 1.1


def test_parameters_of_the_user_step_along():
    """A gain of which the picture knows nothing; other gradients and arrays stay as they are."""
    kind = types_in(select("llvm")).Float
    gain = Adam(lr=0.02, params={"gain": kind(0.5)})
    other, held = kind(2), kind(3)
    dr.enable_grad(other)
    dr.set_grad(other, 7)
    image = IMAGE.copy()

    def loss(picture, step):
        fixed = dr.mean(dr.square(held * 0.2 - other * gain["gain"] * 0.3))
        return squares(picture) + fixed

    eg.fit(image, 50, 100, space="rgb", loss=eg.Loss(loss, parameters=gain))
    assert gain["gain"][0] == pytest.approx(1, abs=0.02)
    assert dr.grad(other)[0] == 7 and dr.grad_enabled(other) and held[0] == 3
    np.testing.assert_array_equal(image, IMAGE)


def dropped(picture, weight):
    """A weight of 0 leaves a number without a derivative."""
    return weight * squares(picture)


def masked(picture, weight):
    """A mask of 0 leaves a derivative of 0."""
    mask = type(picture)(np.full((1, 1, 1), weight, np.float32))
    return dr.mean(dr.square(picture - type(picture)(IMAGE)) * mask, axis=None)


@pytest.mark.parametrize("weighed", [dropped, masked])
def test_a_step_without_a_derivative_moves_nothing(weighed):
    """Neither Gaussians, whose lists are built at each step here, nor texels."""
    steady = replace(eg.DEFAULT, controls=(), decay=1.0, drift=0.01)
    options = {"space": "rgb", "method": steady}
    loss = eg.Loss(lambda p, s: weighed(p, 0.0 if s in (6, 7, 14) else 1.0), judge=squares)
    rested = eg.fit(IMAGE, 50, 15, **options, loss=loss).image
    plain = eg.fit(IMAGE, 50, 12, **options, loss=squares).image
    np.testing.assert_allclose(rested, plain, atol=1e-5)
    values, ends = np.full((SIDE, SIDE, 3), 0.5, np.float32), []
    for every, number in ((3, 18), (1000, 13)):  # the first step rests
        loss = eg.Loss(lambda p, s, n=every: weighed(p, 1.0 if s % n else 0.0))
        base = Pixels.of(values, RGB, TYPES)
        objective = LossObjective.of_loss(loss, [Channels("", RGB, slice(0, 3))], base)
        *_, last = texel_sums(objective, replace(Coarse(), decay=1.0), number, [0.5] * 3)
        ends.append(last.numpy())
    np.testing.assert_array_equal(*ends)


@pytest.mark.parametrize("free", [False, True])
def test_a_loss_needs_a_derivative_at_some_step(free):
    """But at its least value, 0, there is none."""
    given = {"size": (SIDE, SIDE)} if free else {"image": IMAGE}
    options = {**given, "gaussians": 20, "iterations": 8, "space": "rgb"}
    frozen = dr.freeze(lambda picture, wanted: dr.mean(dr.square(picture - wanted), axis=None))
    for loss in (
        lambda p, s: frozen(p, type(p)(IMAGE)),
        lambda p, s: 0 * squares(p),
        lambda p, s: squares(dr.detach(p)),
    ):
        with pytest.raises(ValueError, match=r"not depend on the picture at any step.*dr\.freeze"):
            eg.fit(**options, loss=loss)
    met = eg.fit(**options, loss=lambda p, s: dr.mean(dr.maximum(dr.square(p) - 9, 0), axis=None))
    assert met.loss == 0 and met.stopped == "iterations"


def test_a_loss_differentiates_as_it_likes():
    """A copy, the picture itself and something else: by rows and by steps, of no effect."""

    def looking(picture, step):
        copy = type(picture)(dr.detach(picture))
        dr.enable_grad(copy)
        dr.backward(squares(copy))
        dr.backward(squares(picture))
        assert (dr.grad(copy).numpy() == dr.grad(picture).numpy()).all()
        dr.set_grad(copy, 1)
        dr.forward_to(squares(copy))
        return squares(picture)

    options = {"gaussians": 50, "iterations": 12, "space": "rgb"}
    plain = eg.fit(IMAGE, **options, loss=squares).image
    np.testing.assert_array_equal(eg.fit(IMAGE, **options, loss=looking).image, plain)


@pytest.mark.parametrize(
    "kind",
    [float, np.float32, np.float64, np.asarray, lambda x: np.array([x]), lambda x: int(1e6 * x)],
)
def test_a_judge_returns_any_number(kind):
    loss = eg.Loss(squares, judge=lambda p: kind(np.mean((p.numpy() - IMAGE) ** 2)))
    found = eg.fit(IMAGE, 20, 4, space="rgb", loss=loss)
    assert found.loss == pytest.approx(kind(np.mean((found.image - IMAGE) ** 2)), rel=1e-4)


def test_the_step_is_the_number_of_steps_taken():
    """Rows of the trace ask for step 0; controls for the next step."""
    seen = []

    def loss(picture, step):
        seen.append(step)
        return squares(picture)

    eg.fit(IMAGE, 50, 40, space="rgb", loss=loss)
    assert sorted(set(seen)) == list(range(40)) and len(seen) > 45
    asked = [step for step in seen if step]
    assert asked == sorted(asked)


def test_a_dict_of_maps_is_not_reduced():
    """Dr.Jit alone ends the process."""
    with pytest.raises(TypeError, match=r"take each by its name, such as pictures\['albedo'\]"):
        eg.fit({"albedo": IMAGE}, 10, 4, loss=lambda maps, step: dr.mean(maps, axis=None))


def test_a_loss_runs_where_the_start_is_the_image():
    start = eg.fit(IMAGE, 60, 20, space="rgb").gaussians
    seen = eg.picture_of(start)
    dark = eg.fit(seen, start=start, loss=lambda p, s: dr.mean(dr.square(p - 0.2)), iterations=30)
    assert dark.stopped == "iterations" and dark.loss < 0.7 * dark.trace[0]["loss"]


def test_pytorch():
    torch = pytest.importorskip("torch")

    @dr.wrap(source="drjit", target="torch")
    def loss(picture):
        return ((picture - torch.from_numpy(IMAGE)) ** 2).mean()

    found = eg.fit(IMAGE, 50, 30, space="rgb", loss=lambda picture, step: loss(picture))
    assert found.loss < found.trace[0]["loss"]


@pytest.mark.parametrize(
    ("loss", "message"),
    [
        (lambda p, s: dr.square(p), "array of shape .* dr.mean"),
        (lambda p, s: float(np.mean(p.numpy())), "does not depend on the picture"),
        (lambda p, s: None, "returned NoneType"),
        (lambda p, s: np.float32(1), "does not depend on the picture|returned float32"),
        (lambda p, s: squares(p) * (np.nan if s == 3 else 1), "nan at steps 1-9"),
        (lambda p, s: squares(p) / 0, "its value is inf for a picture"),
        (
            lambda p, s: squares(p) + dr.mean(dr.sqrt(p - p)),
            "derivative at steps 0 and 10; dr.sqrt",
        ),
    ],
)
def test_what_is_no_loss_ends_in_one_line(loss, message):
    with pytest.raises(ValueError, match=message) as error:
        eg.fit(IMAGE, 50, 30, space="rgb", loss=loss)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "needs an image, or a loss and the size"),
        ({"loss": squares}, "needs an image, or a loss and the size"),
        ({"loss": squares, "size": (8, 8), "target_psnr": 30}, "no PSNR"),
        ({"loss": squares, "size": (8, 8), "gaussians": 65}, "takes 1 to 64"),
        ({"loss": squares, "size": (8, 8), "space": {"a": "hsv"}}, "'hsv' is unknown"),
        ({"loss": squares, "size": (8, 8), "space": {"1a": "rgb"}}, "starts with a letter"),
        ({"loss": squares, "size": 8}, r"give \(width, height\)"),
        ({"loss": squares, "size": (8.0, 8.0)}, r"give \(width, height\) in whole pixels"),
        (
            {"loss": squares, "size": (8, 8), "gaussians": [2, 4]},
            "levels are for the squared error",
        ),
        (
            {"image": IMAGE, "target_psnr": 20, "loss": eg.Loss(squares, target=1e-4)},
            "target_psnr and the target of a loss exclude each other",
        ),
        ({"loss": squares, "size": (8, 8), "weight": np.ones((8, 9))}, "9x8 pixels, but size is"),
        ({"loss": squares, "size": (8, 8), "weight": np.ones((8, 8, 2))}, "2 channels, but the"),
        ({"image": IMAGE, "size": (8, 8)}, "size is for a loss without an image"),
        ({"image": IMAGE, "gaussians": [10, 20], "loss": squares}, "levels are for the squared"),
    ],
)
def test_options_that_do_not_fit_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        eg.fit(**options)
    for arguments, text in (
        ({"bounds": (1, 0)}, "smaller"),
        ({"bounds": 5}, "bounds are 5; give two numbers"),
        ({"bounds": (0, None)}, "give two numbers"),
        ({"bounds": (0, np.inf)}, "give two numbers"),
        ({"target": 0}, "above 0"),
        ({"pixels": 0}, "pixels is 0; it must be at least 1"),
    ):
        with pytest.raises(ValueError, match=text):
            eg.Loss(squares, **arguments)
    assert eg.Loss(squares, bounds=np.array([0, 1])).bounds == (0, 1)
    with pytest.raises(TypeError, match=r"is a Loss; change one by dataclasses\.replace"):
        eg.Loss(eg.Loss(squares), bounds=(0, 1))
    with pytest.raises(TypeError, match="target is 'x'; it must be a number"):
        eg.Loss(squares, target="x")
    with pytest.raises(TypeError, match="no function"):
        eg.Loss(3)
    with pytest.raises(TypeError, match=r"<lambda>\(p\) is called with \(picture, step\)"):
        eg.fit(IMAGE, 20, 10, loss=lambda p: squares(p))
    with pytest.raises(TypeError, match=r"judge <lambda>\(p, step\) is called with \(picture\)"):
        eg.Loss(squares, judge=lambda p, step: 0.0)
    with pytest.raises(TypeError, match="give an optimiser"):
        eg.Loss(squares, parameters={"gain": 1})
    with pytest.raises(TypeError, match="give an optimiser of"):
        eg.Loss(squares, parameters=SimpleNamespace(step=lambda: None))  # as that of PyTorch
    with pytest.raises(TypeError, match="function is frozen by"):
        eg.Loss(dr.freeze(squares))
    with pytest.raises(TypeError, match="fit_many takes no loss; call eigengs_dr"):
        eg.fit_many([IMAGE], loss=squares)
    with pytest.raises(ValueError, match="the judge is nan"):
        eg.fit(IMAGE, 20, 10, loss=eg.Loss(squares, judge=lambda p: p.array[0] * np.nan))


@pytest.mark.parametrize("last", [20, 80])
def test_an_interrupted_fit_keeps_its_set(last):
    """Of texels, to which Gaussians are fitted yet; and of Gaussians."""

    def stop(step, steps, row):
        assert steps == 100
        if step >= last:
            raise KeyboardInterrupt

    options = {"loss": squares, "size": (SIDE, SIDE), "gaussians": 50, "space": "rgb"}
    with pytest.raises(eg.Interrupted) as error:
        eg.fit(**options, iterations=100, progress=stop)
    result = error.value.result
    assert len(result.gaussians) == 50 and result.iterations == last
    assert result.stopped == "interrupted" and result.loss < 0.05


STOPS = {"first": 0, "texels": 2, "later": 13}
"""Steps at which a loss ends a fit of 20, in half of them texels without an image."""


@pytest.mark.parametrize(
    ("kind", "stop"),
    [
        *product(("image", "target"), ("first", "later", "judge", "from a judge on")),
        *product(("free", "free target"), (*STOPS, "judge", "from a judge on")),
    ],
)
def test_a_loss_or_a_judge_may_end_the_fit(kind, stop):
    """The best set so far is there, also if it measures no more; other errors pass as they are."""
    ended = []

    def loss(picture, step):
        if step >= STOPS.get(stop, 99):
            raise ended[0]
        return squares(picture)

    def judge(picture):
        judged.append(picture)
        if "judge" in stop and (len(judged) == 2 or ("on" in stop and len(judged) > 2)):
            raise ended[0]
        return squares(picture)

    given = {"image": IMAGE} if kind in ("image", "target") else {"size": (SIDE, SIDE)}
    given |= {} if "target" in kind else {"gaussians": 30}
    asked = eg.Loss(loss, judge=judge, target=1e-4 if "target" in kind else None)
    errors = KeyboardInterrupt(), StopIteration("mine"), RuntimeError("mine")
    for error in errors if stop == "first" else errors[:2]:
        ended[:], judged = [error], []
        with pytest.raises(BaseException) as got:
            eg.fit(**given, iterations=20, space="rgb", loss=asked)
        if isinstance(error, KeyboardInterrupt):
            assert isinstance(got.value, eg.Interrupted)
            result = got.value.result
            assert result.stopped == "interrupted" and result.image.shape == IMAGE.shape
            assert len(result.gaussians) == given.get("gaussians", len(result.gaussians))
            assert result.iterations <= max(20, 2 * STOPS.get(stop, 20))
        else:
            assert got.value is error


def test_an_operation_of_a_loss_may_end_the_fit():
    """Dr.Jit wraps the error, as that of a network of PyTorch."""

    class Ends(dr.CustomOp):
        def eval(self, picture):
            raise KeyboardInterrupt

    def loss(picture, step):
        return squares(dr.custom(Ends, picture) if step == 3 else picture)

    with pytest.raises(eg.Interrupted) as error:
        eg.fit(IMAGE, 20, 10, space="rgb", loss=loss)
    assert error.value.result.iterations == 3


@pytest.mark.parametrize("space", ["rgb", "ycbcr", "log", "normal"])
def test_the_slope_is_a_finite_difference(backend, space):
    """Of sums in tile layout, through what the picture shows."""
    double = _types(select(backend).__name__, 64)
    random = np.random.default_rng(5)
    values = random.uniform(0.2, 0.8, (9, 11, 3))
    target = double.Tensor(random.uniform(0.2, 0.8, (9, 11, 3)))

    def loss(picture, step):
        return dr.sum(dr.square(picture - target) * (1 + picture), axis=None)

    known, values32 = space_of(space), values.astype(np.float32)
    base = Pixels.of(values32, known, double)
    fitted = Target(values32, values32, Affine(0.9, 0.05))
    shown = [Channels("", known, slice(0, 3), (fitted,))]
    objective = LossObjective.of_loss(eg.Loss(loss), shown, base)
    rows = double.Float(values.ravel())
    value, slopes, size = objective.derivative(objective.seen(rows))
    slope = objective.pull_back(rows, slopes).numpy() / objective.calls.unit
    for place in random.integers(0, values.size, 12):
        ends = []
        for step in (-1e-6, 1e-6):
            moved = values.ravel().copy()
            moved[place] += step
            ends.append(objective.judge(objective.seen(double.Float(moved))))
        assert slope[place] == pytest.approx((ends[1] - ends[0]) / 2e-6, rel=1e-4, abs=1e-6)
    assert value[0] > 0 and size[0] == pytest.approx(
        np.abs(slopes[0].numpy()).sum() / objective.calls.unit
    )


def test_the_curvature_of_the_squared_error_is_its_weight():
    """The secant of each tile is exact, up to the unit and what a tile of mean error is pulled."""
    gaussians = eg.fit(IMAGE, 60, 20, space="rgb").gaussians
    noise = np.random.default_rng(5).normal(0, 0.1, IMAGE.shape).astype(np.float32)
    image = eg.render(gaussians).numpy() + noise
    base = Pixels.plain(image, gaussians)
    weight = np.ones((SIDE, SIDE, 1), np.float32)
    weight[:, SIDE // 2 :] = 4

    def loss(picture, step):
        error = picture - type(picture)(image)
        return dr.sum(dr.square(error) * type(picture)(weight), axis=None)

    objective = LossObjective.of_loss(eg.Loss(loss), [Channels("", RGB, slice(0, 3))], base)
    near = objective.around(gaussians)
    curvature = near.model.curvature.numpy().reshape(-1, base.grid.pixels)
    assert (curvature.max(axis=1) - curvature.min(axis=1) <= 1e-6).all()
    left, right = np.split(curvature.mean(axis=1).reshape(base.grid.ny, base.grid.nx), 2, axis=1)
    assert 3 < np.median(right) / np.median(left) < 4


@pytest.mark.parametrize("size", [(16, 16), (21, 13), (9, 40)])
def test_levels_of_a_pyramid(backend, size):
    """The transpose is one, a constant stays one, and a ramp a ramp but at its ends."""
    levels = texel_levels(*size)
    assert min(levels[-1].width, levels[-1].height) >= 4 and levels[0].texels == np.prod(size)
    types, random = types_in(select(backend)), np.random.default_rng(3)
    fine, coarse = levels[0], levels[1]
    x, y = (random.normal(size=level.texels).astype(np.float32) for level in (coarse, fine))
    up = enlarge(types.Float(x), coarse, fine).numpy()
    down = shrink(types.Float(y), fine, coarse).numpy()
    assert np.dot(up, y) == pytest.approx(np.dot(x, down), rel=1e-4, abs=1e-3)
    ones = enlarge(types.Float(np.ones(coarse.texels)), coarse, fine).numpy()
    np.testing.assert_allclose(ones, 1, rtol=1e-6)
    ramp = np.tile(np.arange(coarse.width, dtype=np.float32), (coarse.height, 1))
    shown = enlarge(types.Float(ramp.ravel()), coarse, fine).numpy()
    row = shown.reshape(fine.height, fine.width)[0, 1:-1]
    inner = row[: 2 * (coarse.width - 1)][: len(row)]
    np.testing.assert_allclose(np.diff(inner[: 2 * coarse.width - 3]), 0.5, rtol=1e-5)


@pytest.mark.parametrize("size", [(16, 16), (21, 13)])
def test_texels_without_a_derivative_show_what_lies_around(backend, size):
    """Those with one stay; a channel without any keeps its mean."""
    levels, types = texel_levels(*size), types_in(select(backend))
    y, x = np.mgrid[: size[1], : size[0]].astype(np.float32)
    hole = (abs(x - 6) < 3) & (abs(y - 6) < 3)
    true = 0.2 + 0.02 * x
    picture = types.FloatX([np.where(hole, 0.9, true).ravel(), np.full(true.size, 0.7)])
    squares = types.FloatX([np.where(hole, 0, 1).ravel(), np.zeros(true.size)])
    filled, rest = (
        row.numpy().reshape(true.shape) for row in fill_unseen(picture, squares, levels)
    )
    np.testing.assert_allclose(filled[~hole], true[~hole], atol=2e-3)
    np.testing.assert_allclose(filled[hole], true[hole], atol=0.06)
    np.testing.assert_allclose(rest, 0.7, rtol=1e-5)


def test_a_half_that_a_loss_ignores_looks_like_the_other():
    """Instead of the grey that a fit starts from."""
    red, half = np.float32([0.8, 0.2, 0.1]), np.s_[:, : SIDE // 2]

    def left(picture, step=0):
        return dr.mean(dr.square(picture[half] - type(picture)(red)), axis=None)

    result = eg.fit(loss=left, size=(SIDE, SIDE), gaussians=60, iterations=120, space="rgb")
    np.testing.assert_allclose(result.image[:, SIDE // 2 + 4 :].mean((0, 1)), red, atol=0.05)


def test_rows_between_the_ends_call_no_loss():
    """Their loss is the mean of the steps since the row before; the ends measure their sets."""
    calls = []

    def counted(picture, step):
        calls.append(step)
        return squares(picture)

    options = {"size": (SIDE, SIDE), "gaussians": 50, "iterations": 60, "space": "rgb"}
    found = eg.fit(loss=counted, **options)
    assert len(calls) == 60 + 2 and calls.count(0) == 1 + 2
    assert found.loss == pytest.approx(squares(eg.render(found.gaussians)).array[0], rel=1e-5)
    losses = [row["loss"] for row in found.trace]
    assert losses[0] > losses[-1] and len(losses) == 5  # texels; 0, 10, 20 and 30 steps after
    for number in (0, 1):  # no step of texels: there is no mean
        texels, first, *_ = eg.fit(loss=squares, **options | {"iterations": number}).trace
        assert texels["loss"] > 0.01 and first["loss"] > 0.01


def test_the_average_of_sets_is_quieter_than_the_last():
    """With noisy derivatives, at equal rates."""

    def noisy(picture, step):
        noise = np.random.default_rng(step).normal(0, 0.5, IMAGE.shape).astype(np.float32)
        return dr.mean(dr.square(picture - type(picture)(IMAGE + noise)), axis=None)

    start = eg.fit(IMAGE, 100, 50, space="rgb").gaussians
    options = {"loss": noisy, "size": (SIDE, SIDE), "start": start, "iterations": 100}
    method = eg.COARSE_TO_FINE.at_rates(3)
    mean, last = (eg.fit(**options, method=m).image for m in (method, replace(method, average=0.0)))
    assert np.mean((mean - IMAGE) ** 2) < 0.8 * np.mean((last - IMAGE) ** 2)
    with pytest.raises(ValueError, match="average is"):
        replace(eg.DEFAULT, average=0.5)


def test_a_loss_sees_what_is_rendered():
    """The picture of a step is that of `render` for the same set."""
    seen = []

    def loss(picture, step):
        seen.append(picture.numpy())
        return squares(picture)

    start = eg.fit(IMAGE, 80, 0).gaussians
    eg.fit(loss=loss, size=(SIDE, SIDE), start=start, iterations=1)
    np.testing.assert_allclose(seen[0], eg.render(start).numpy(), atol=2e-6)

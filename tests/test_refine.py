"""Refinement: coordinates, optimiser, loop and `fit`, on any image, however it goes."""

import signal
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from unittest.mock import patch

import drjit as dr
import drjit.opt
import numpy as np
import pytest
from drjit import JitFlag
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scenes import COUNT, SIZE, Scene, few, random_scene, scenes, small_model

from eigengs_dr import fitting, starting
from eigengs_dr.adam import Adam
from eigengs_dr.adan import Adan
from eigengs_dr.backend import select
from eigengs_dr.color import rgb_to_ycbcr, to_coded, to_linear
from eigengs_dr.coordinates import CHOLESKY, CHOLESKY_BOUND, NATURAL
from eigengs_dr.descent import Schedule, descend
from eigengs_dr.fitting import fit
from eigengs_dr.gaussians import NARROWEST
from eigengs_dr.metrics import psnr
from eigengs_dr.place import grid
from eigengs_dr.presets import PRESETS
from eigengs_dr.refine import refine, rows_at
from eigengs_dr.rendering import picture_of, render

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


def check_sound(result, image):
    """All numbers are finite, and the result is the best row and not worse than the start."""
    assert np.isfinite(result.image).all()
    assert all(np.isfinite(v).all() for v in result.gaussians.to_arrays().values())
    rendered = picture_of(result.gaussians)
    added = 0 if result.mean_image is None else result.mean_image
    np.testing.assert_array_equal(result.image, rendered + added)
    reached = psnr(image, result.image, space="ycbcr")
    assert reached == max(figures(result))
    assert reached >= result.trace[0]["psnr_ycbcr"]


# --- Adam --------------------------------------------------------------------------------------


@pytest.mark.parametrize("betas", [(0.9, 0.9), (0.9, 0.99)])
def test_adam_is_that_of_drjit_where_that_works(backend, betas):
    """Equal to the last bit, over the step from which on nothing is debiased."""
    Float = select(backend).Float
    settings = {"beta_1": betas[0], "beta_2": betas[1], "epsilon": 1e-12}
    ours, theirs = (kind(0.1, {"x": Float(1, -2)}, **settings) for kind in (Adam, drjit.opt.Adam))
    for first in (0, ours.last - 5):
        for optimizer in (ours, theirs):
            _, *averages = optimizer.state["x"][-1]
            optimizer.state["x"] = *optimizer.state["x"][:-1], (UInt(backend, first), *averages)
        for _ in range(10):
            for optimizer in (ours, theirs):
                dr.backward(dr.square(optimizer["x"]) * Float(1, 3))
                optimizer.step()
            np.testing.assert_array_equal(ours["x"].numpy(), theirs["x"].numpy())


def UInt(backend, value):
    return dr.opaque(select(backend).UInt32, value)


def test_adam_survives_the_steps_at_which_a_power_leaves_the_range_of_doubles(backend):
    """With a beta of 0.9 the steps 6,734 to 6,736: Dr.Jit's own makes all variables NaN."""
    Float = select(backend).Float
    optimizer = Adam(0.1, {"x": Float(1, -2)}, beta_1=0.9, beta_2=0.9, epsilon=1e-12)
    for t in range(6700, 6760):
        _, *averages = optimizer.state["x"][-1]
        optimizer.state["x"] = *optimizer.state["x"][:-1], (UInt(backend, t), *averages)
        dr.backward(optimizer["x"] * Float(3, -4))
        optimizer.step()
    # Averages that start at 0 and are not debiased hold a share of 1 - 0.9^k of a steady gradient.
    moved = 0.1 * sum(np.sqrt(1 - 0.9**k) for k in range(1, 61))
    np.testing.assert_allclose(optimizer["x"].numpy(), [1 - moved, -2 + moved], rtol=1e-4)


def test_adam_refuses_averages_of_which_one_outlives_the_range_of_the_other():
    with pytest.raises(ValueError, match="closer to each other"):
        Adam(0.1, beta_1=0.9, beta_2=0.999)


# --- Adan --------------------------------------------------------------------------------------


def adan_by_hand(start, gradient, rate, steps, betas=(0.98, 0.92, 0.99), epsilon=1e-8):
    """Algorithm 1 of the paper, its betas subtracted from one as in its authors' code."""
    x = np.array(start, np.float64)
    m, v, n = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
    last = None
    path = []
    for t in range(1, steps + 1):
        g = gradient(x)
        d = np.zeros_like(g) if last is None else g - last
        m = betas[0] * m + (1 - betas[0]) * g
        v = betas[1] * v + (1 - betas[1]) * d
        n = betas[2] * n + (1 - betas[2]) * (g + betas[1] * d) ** 2
        m_hat, v_hat, n_hat = (
            average / (1 - beta**t) for average, beta in zip((m, v, n), betas, strict=True)
        )
        x = x - rate * (m_hat + betas[1] * v_hat) / (np.sqrt(n_hat) + epsilon)
        last = g
        path.append(x)
    return np.array(path)


@pytest.mark.parametrize(("bits", "rtol"), [(32, 1e-4), (64, 1e-10)])
@pytest.mark.parametrize("betas", [(0.98, 0.92, 0.99), (0.9, 0.5, 0.95)])
def test_adan(backend, bits, rtol, betas):
    """Two parameters of one optimiser, each with its own rate, on curved losses."""
    module = select(backend)
    Float = module.Float64 if bits == 64 else module.Float
    starts = {"x": np.array([1.0, -2, 0.5]), "y": np.linspace(-1, 1, 7)}
    rates, curvature = {"x": 0.1, "y": 0.02}, {"x": 3.0, "y": 0.5}
    optimizer = Adan(1.0, {k: Float(v) for k, v in starts.items()}, betas=betas)
    optimizer.set_learning_rate(rates)
    paths = {"x": [], "y": []}
    for _ in range(30):
        loss = sum(
            dr.sum(0.25 * dr.square(dr.square(optimizer[k])) + curvature[k] * dr.sin(optimizer[k]))
            for k in starts
        )
        dr.backward(loss)
        optimizer.step()
        for k, path in paths.items():
            path.append(optimizer[k].numpy())
    for k, start in starts.items():
        expected = adan_by_hand(
            start, lambda x, k=k: x**3 + curvature[k] * np.cos(x), rates[k], 30, betas
        )
        scale = np.abs(expected - start).max()
        np.testing.assert_allclose(paths[k], expected, rtol=0, atol=rtol * scale)


def test_adan_takes_a_full_first_step(backend):
    """m / sqrt(n) is the sign of the first gradient, whatever its size."""
    Float = select(backend).Float
    optimizer = Adan(0.25, {"x": Float(0, 0, 0)})
    dr.backward(optimizer["x"] * Float(1e-3, -1, 1e3))
    optimizer.step()
    np.testing.assert_allclose(optimizer["x"].numpy(), [-0.25, 0.25, -0.25], rtol=1e-4)


def test_adan_rests_where_nothing_changes(backend):
    Float = select(backend).Float
    optimizer = Adan(0.25, {"x": Float(1, 2)})
    for _ in range(3):
        dr.backward(optimizer["x"] * Float(0, 0))
        optimizer.step()
    np.testing.assert_array_equal(optimizer["x"].numpy(), [1, 2])


def test_adan_starts_again_after_a_reset(backend):
    Float = select(backend).Float
    optimizer = Adan(0.1, {"x": Float(1, 2)})

    def first_step():
        dr.backward(dr.sum(dr.square(optimizer["x"])))
        optimizer.step()
        return optimizer["x"].numpy()

    before = first_step()
    first_step()
    optimizer["x"] = Float(1, 2)
    optimizer.reset("x")
    np.testing.assert_array_equal(first_step(), before)


@pytest.mark.parametrize("betas", [(1.0, 0.9, 0.9), (0.9, -0.1, 0.9), (0.9, 0.9, np.nan)])
def test_adan_refuses_betas(betas):
    with pytest.raises(ValueError, match="betas"):
        Adan(0.1, betas=betas)


# --- Coordinates -------------------------------------------------------------------------------


@few
@given(scene=scenes())
@pytest.mark.parametrize("coordinates", [NATURAL, CHOLESKY], ids=["natural", "cholesky"])
def test_there_and_back(backend, coordinates, scene):
    """Those of GaussianImage hold means inside the image only."""
    scene = scene._replace(mean=np.clip(scene.mean, 0.01, np.array(SIZE) - 0.01))
    gaussians = scene.on(backend)
    back = coordinates.to(gaussians, coordinates.of(gaussians)).to_arrays()
    np.testing.assert_allclose(back["mean"], scene.mean, atol=1e-3)
    scale = np.abs(scene.factor).max(axis=1, keepdims=True)
    assert (np.abs(back["factor"] - scene.factor) <= 1e-4 * scale).all()
    np.testing.assert_array_equal(back["color"], np.float32(scene.color))
    np.testing.assert_array_equal(back["background"], np.float32(scene.background))


def test_cholesky_coordinates(backend):
    """``Sigma = L L^T`` with the bound on L's diagonal; means through tanh."""
    rng = np.random.default_rng(0)
    variables = {"mean": rng.normal(size=(2, COUNT)), "cholesky": rng.uniform(0, 2, (3, COUNT))}
    module = select(backend)
    fixed = random_scene().on(backend)
    moved = CHOLESKY.to(
        fixed,
        {
            "mean": module.Array2f(*variables["mean"].astype("f4")),
            "cholesky": module.Array3f(*variables["cholesky"].astype("f4")),
            "color": fixed.color,
        },
    ).to_arrays()
    l1, l2, l3 = variables["cholesky"] + np.array([[CHOLESKY_BOUND], [0], [CHOLESKY_BOUND]])
    lower = np.array([[l1, 0 * l1], [l2, l3]]).transpose(2, 0, 1)
    a, b, c = moved["factor"].astype(float).T
    factor = np.array([[a, b], [0 * a, c]]).transpose(2, 0, 1)
    inverse = np.einsum("nji,njk->nik", factor, factor)
    np.testing.assert_allclose(
        np.linalg.inv(inverse), np.einsum("nij,nkj->nik", lower, lower), rtol=1e-4, atol=1e-4
    )
    expected = (np.tanh(variables["mean"].T) + 1) / 2 * SIZE
    np.testing.assert_allclose(moved["mean"], expected, rtol=1e-5)


@pytest.mark.parametrize("coordinates", [NATURAL, CHOLESKY], ids=["natural", "cholesky"])
def test_what_is_not_a_variable_is_that_of_the_set(backend, coordinates):
    """As `Coordinates.to` says."""
    gaussians = random_scene().on(backend)
    moved = coordinates.to(gaussians, {"color": gaussians.color * 2}).to_arrays()
    np.testing.assert_array_equal(moved["mean"], gaussians.to_arrays()["mean"])
    np.testing.assert_array_equal(moved["factor"], gaussians.to_arrays()["factor"])


any_floats = st.floats(width=32, allow_nan=True, allow_infinity=True)


@few
@given(values=hnp.arrays(np.float32, (8, COUNT), elements=any_floats))
def test_natural_variables_come_back_into_their_bounds(backend, values):
    module = select(backend)
    fixed = random_scene().on(backend)
    variables = {
        "mean": module.Array2f(*values[:2]),
        "factor": module.Array3f(*values[2:5]),
        "color": module.ArrayXf(list(values[5:])),
    }
    found = NATURAL.to(fixed, NATURAL.bounded(fixed, variables)).to_arrays()
    slack = 1 + 1e-5  # of going through the units of the variables
    assert ((found["mean"] >= 0) & (found["mean"] <= np.array(SIZE) * slack)).all()
    diagonal = found["factor"][:, [0, 2]]
    assert (diagonal * slack >= 1 / (2 * max(SIZE))).all()
    assert (np.abs(found["factor"]) <= slack / NARROWEST).all()
    assert np.isfinite(found["color"]).all()


# --- The loop ----------------------------------------------------------------------------------


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
    assert sorted(rows_at(iterations)) == sorted(
        {m for m in usual if m <= iterations} | {iterations}
    )


# --- Fit ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("init", starting.INITS)
def test_fit_improves_on_its_start(backend, init):
    result = fit(picture(), SPLATS, 60, init=init, basis=small_model(backend), backend=backend)
    check_sound(result, picture())
    assert figures(result)[-1] > figures(result)[0] + 1
    assert len(result.gaussians) == SPLATS
    assert result.image.shape == (SIDE, SIDE, 3)
    assert (result.gaussians.width, result.gaussians.height) == (SIDE, SIDE)


def test_fit_is_much_better_than_a_constant(backend):
    result = fit(picture(), SPLATS, 100, backend=backend)
    flat = np.broadcast_to(picture().mean(axis=(0, 1)), picture().shape)
    assert figures(result)[-1] > psnr(picture(), flat, space="ycbcr") + 15


def test_trace(backend):
    result = fit(picture(), SPLATS, 30, backend=backend)
    assert [row["iteration"] for row in result.trace] == [0, 10, 20, 30]
    for row in result.trace:
        assert sorted(row) == ["iteration", "psnr_rgb", "psnr_ycbcr", "seconds"]
        assert all(type(row[k]) is float for k in ("seconds", "psnr_rgb", "psnr_ycbcr"))
    seconds = [row["seconds"] for row in result.trace]
    assert seconds == sorted(seconds)
    assert 0 < result.seconds_init <= seconds[0]
    assert seconds[-1] <= result.seconds
    best = max(result.trace, key=lambda row: row["psnr_ycbcr"])
    assert psnr(picture(), result.image, space="rgb") == best["psnr_rgb"]


def test_zero_iterations_keep_the_solved_start(backend):
    result = fit(picture(), SPLATS, 0, backend=backend)
    check_sound(result, picture())
    assert len(result.trace) == 1
    assert (result.iterations, result.stopped) == (0, "iterations")
    assert figures(result)[0] > 20


def test_more_solve_steps_start_better(backend):
    starts = [
        figures(fit(picture(), SPLATS, 0, solve_steps=steps, backend=backend))[0]
        for steps in (0, 2, 20)
    ]
    assert starts == sorted(starts)
    assert starts[2] > starts[0] + 5


@presets
def test_one_seed_gives_one_result(backend, preset):
    eigen = preset == "eigengs"  # which draws nothing
    init, basis = ("auto" if eigen else "random"), small_model(backend)

    def run(iterations, seed):
        return fit(picture(), SPLATS, iterations, init, basis, preset, seed=seed, backend=backend)

    first, second = run(30, 5), run(30, 5)
    assert figures(first) == figures(second)
    for name, value in first.gaussians.to_arrays().items():
        np.testing.assert_array_equal(value, second.gaussians.to_arrays()[name])
    assert (figures(run(0, 6))[0] != figures(first)[0]) == (not eigen)


def test_gaussianimage(backend):
    """From random colours over black, with one rate."""
    result = fit(picture(), SPLATS, 200, preset="gaussianimage", backend=backend)
    check_sound(result, picture())
    assert figures(result) == sorted(figures(result))
    assert figures(result)[-1] > figures(result)[0] + 2
    assert result.gaussians.to_arrays()["background"].tolist() == [0, 0, 0]


@presets
@pytest.mark.parametrize("value", [0.0, 0.3, 1.0])
def test_constant_images(backend, preset, value):
    image = np.full((SIDE, SIDE, 3), value, np.float32)
    basis = small_model(backend)
    result = fit(image, SPLATS, 60, preset=preset, basis=basis, backend=backend)
    check_sound(result, image)
    if preset == "default":
        assert figures(result)[0] > 100


def test_black_ends_by_plateau(backend):
    result = fit(np.zeros((SIDE, SIDE, 3)), SPLATS, 1000, backend=backend)
    assert result.stopped == "plateau"
    assert result.iterations < 1000


@pytest.mark.parametrize("shape", [(1, 1), (1, 37), (37, 1), (2, 3)])
@pytest.mark.parametrize("init", ["adaptive", "grid", "random"])
def test_narrow_images(backend, shape, init):
    image = np.random.default_rng(0).uniform(0, 1, (*shape, 3)).astype(np.float32)
    count = max(1, shape[0] * shape[1] // 2)
    result = fit(image, count, 12, init=init, backend=backend)
    check_sound(result, image)
    assert result.image.shape == image.shape


@pytest.mark.parametrize("count", [1, 2, SIDE * SIDE])
def test_fewest_and_most_splats(backend, count):
    result = fit(picture(), count, 12, backend=backend)
    check_sound(result, picture())
    assert len(result.gaussians) == count


@pytest.mark.parametrize("color", ["ycbcr", "rgb"])
def test_colour_spaces(backend, color):
    result = fit(picture(), SPLATS, 60, color=color, backend=backend)
    check_sound(result, picture())
    assert result.gaussians.space == color
    assert result.trace[-1]["psnr_rgb"] > 25


def test_fit_in_linear_light(backend):
    """The sum is linear light, and its picture sRGB."""
    result = fit(picture(), SPLATS, 60, color="linear", backend=backend)
    check_sound(result, picture())
    assert result.gaussians.space == "linear"
    light = render(result.gaussians).numpy()
    np.testing.assert_allclose(result.image, to_coded(np.maximum(light, 0)), atol=1e-6)
    close = -10 * np.log10(np.mean((light - to_linear(picture())) ** 2))
    coded = -10 * np.log10(np.mean((light - picture()) ** 2))
    assert close > 25 > coded
    assert result.trace[-1]["psnr_rgb"] > 25


def test_a_ramp_of_light_needs_no_more_than_a_few_splats(backend):
    """In sRGB it is bent; the light of the fit rises in equal steps."""
    light = np.broadcast_to(np.linspace(0.2, 0.8, SIDE)[:, None], (SIDE, SIDE, 3))
    result = fit(to_coded(light), SPLATS, 60, color="linear", backend=backend)
    columns = render(result.gaussians).numpy().mean(axis=(0, 2))
    np.testing.assert_allclose(columns, light[0, :, 0], atol=4e-3)


def test_linear_light_places_by_what_one_sees(backend):
    """As many splats in the dark as a fit of the coded picture has there."""
    placed = [
        fit(picture(), SPLATS, 0, color=color, backend=backend).gaussians.to_arrays()
        for color in ("linear", "rgb")
    ]
    np.testing.assert_array_equal(placed[0]["mean"], placed[1]["mean"])
    np.testing.assert_array_equal(placed[0]["factor"], placed[1]["factor"])


def test_linear_light_weighs_errors_in_the_dark(backend, monkeypatch):
    """Without weights, what shows there after coding would be worse."""
    dark = picture() * np.linspace(0.05, 1, SIDE, dtype=np.float32)[:, None]
    shown = []
    for darkness in (starting.DARKNESS, 0.0):
        monkeypatch.setattr(starting, "DARKNESS", darkness)
        image = fit(dark, SPLATS, 60, color="linear", backend=backend).image
        shown.append(np.square(image - dark)[: SIDE // 3].mean())
    assert shown[0] < 0.85 * shown[1]


def test_negative_light_is_black(backend):
    scene = random_scene(0, SPLATS, (SIDE, SIDE))
    gaussians = scene._replace(background=np.full(3, -0.5)).on(backend, space="linear")
    light, shown = render(gaussians).numpy(), picture_of(gaussians)
    assert (light < 0).any()
    assert (shown[light <= 0] == 0).all()
    assert np.isfinite(shown).all()


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


@presets
@pytest.mark.parametrize("channels", [1, 3])
def test_data_is_taken_as_it_is(backend, preset, channels):
    data = picture()[..., :channels]
    if preset == "eigengs":
        with pytest.raises(ValueError, match="color is 'data', but the basis is in 'ycbcr'; use"):
            fit(data, SPLATS, 3, preset=preset, basis=small_model(backend), color="data")
        return
    result = fit(data, SPLATS, 60, preset=preset, color="data", backend=backend)
    assert result.gaussians.space == "data"
    assert result.gaussians.channels == channels
    assert result.image.shape == data.shape
    np.testing.assert_array_equal(result.image, render(result.gaussians).numpy())
    best = max(result.trace, key=lambda row: row["psnr_ycbcr"])
    error = result.image.astype(np.float64) - data
    assert best["psnr_ycbcr"] == pytest.approx(-10 * np.log10(np.mean(error**2)), abs=1e-6)
    levels = [np.rint(np.clip(image, 0, 1) * 255) / 255 for image in (result.image, data)]
    rounded = -10 * np.log10(np.mean((levels[0] - levels[1]) ** 2, dtype=np.float64))
    assert best["psnr_rgb"] == pytest.approx(rounded, abs=1e-4)
    assert figures(result)[-1] > figures(result)[0] + 1


@pytest.mark.parametrize("init", ["adaptive", "grid", "random"])
def test_data_of_one_channel(backend, init):
    """Of two axes or of three; what three equal channels give, if one is enough."""
    data = picture()[..., 0]
    one = fit(data, SPLATS, 20, init=init, color="data", backend=backend)
    same = fit(data[..., None], SPLATS, 20, init=init, color="data", backend=backend)
    assert one.gaussians.channels == same.gaussians.channels == 1
    np.testing.assert_array_equal(one.image, same.image)
    assert figures(one)[-1] > 20


def test_kinds_of_images(backend):
    """Grey of two and of three axes, bytes, double precision, lists: one picture, one result."""
    image = np.round(picture() * 255).astype(np.uint8)
    grey = image[..., :1]
    expected = figures(fit(np.repeat(grey, 3, axis=2), SPLATS, 10, backend=backend))
    for same in (grey, grey[..., 0], grey / 255, (grey / 255).astype(np.float32), grey.tolist()):
        same = np.asarray(same, np.uint8) if isinstance(same, list) else same
        found = figures(fit(same, SPLATS, 10, backend=backend))
        np.testing.assert_allclose(found, expected, atol=1e-3)


def test_the_image_is_left_alone(backend):
    image = picture()
    fit(image, SPLATS, 3, backend=backend)
    np.testing.assert_array_equal(image, picture())


@pytest.mark.parametrize("counts", [(50, 100, 200), (200, 100, 50)], ids=["growing", "shrinking"])
def test_fits_of_several_sizes_one_after_the_other(backend, counts):
    for count in counts:
        check_sound(fit(picture(), count, 3, backend=backend), picture())


# --- How it ends -------------------------------------------------------------------------------


@pytest.mark.parametrize("when", [0, 10, 30])
def test_interruption_keeps_the_best_so_far(backend, when):
    def interrupt(iteration, iterations, row):
        if iteration >= when:
            raise KeyboardInterrupt

    result = fit(picture(), SPLATS, 60, progress=interrupt, backend=backend)
    check_sound(result, picture())
    assert (result.iterations, result.stopped) == (when, "interrupted")
    rows = [row["iteration"] for row in result.trace]
    assert rows == [m for m in (0, 10, 20, 50) if m <= when]


def press_ctrl_c(*arguments):
    signal.raise_signal(signal.SIGINT)


def test_ctrl_c(backend):
    """It ends the run at the next step, and is the caller's again afterwards."""
    before = signal.getsignal(signal.SIGINT)

    def progress(iteration, iterations, row):
        if iteration == 10:
            press_ctrl_c()

    result = fit(picture(), SPLATS, 60, progress=progress, backend=backend)
    assert result.stopped == "interrupted"
    assert result.iterations in (10, 11)
    assert [row["iteration"] for row in result.trace] == [0, 10]
    assert all(np.isfinite(v).all() for v in result.gaussians.to_arrays().values())
    assert signal.getsignal(signal.SIGINT) is before


def place_and_press(image, count, generator):
    press_ctrl_c()
    return grid(image, count, generator)


@pytest.mark.parametrize("iterations", [0, 1, 60])
def test_ctrl_c_before_refinement(backend, iterations):
    """The start is returned, and the caller told."""
    with patch.dict(starting.PLACES, grid=place_and_press):
        result = fit(picture(), SPLATS, iterations, init="grid", backend=backend)
    check_sound(result, picture())
    assert len(result.trace) == 1
    assert result.stopped == "interrupted"


def test_ctrl_c_is_the_callers_after_an_error(backend):
    before = signal.getsignal(signal.SIGINT)
    with patch.dict(starting.PLACES, grid=lambda *a: 1 / 0), pytest.raises(ZeroDivisionError):
        fit(picture(), SPLATS, 10, init="grid", backend=backend)
    assert signal.getsignal(signal.SIGINT) is before


def test_fit_in_a_thread(backend):
    """Where no signals arrive."""
    with ThreadPoolExecutor(1) as pool:
        result = pool.submit(fit, picture(), SPLATS, 10, backend=backend).result()
    check_sound(result, picture())


def test_other_errors_of_the_caller_are_passed_on(backend):
    def fail(iteration, iterations, row):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fit(picture(), SPLATS, 10, progress=fail, backend=backend)


def test_progress(backend):
    """Told every ten steps, with the last row of the trace."""
    told = []
    result = fit(picture(), SPLATS, 45, progress=lambda *a: told.append(a), backend=backend)
    assert [t[0] for t in told] == [0, 10, 20, 30, 40, 45]
    assert {t[1] for t in told} == {45}
    assert all(row in result.trace for *_, row in told)
    assert told[-1][2] is result.trace[-1]


@presets
@pytest.mark.parametrize("factor", [10, 1000])
def test_rates_far_too_high(backend, preset, factor):
    """Nothing but finite numbers, and never worse than the start."""
    method = PRESETS[preset]
    rates = {name: rate * factor for name, rate in method.schedule.rates.items()}
    wild = replace(method, schedule=replace(method.schedule, rates=rates))
    with patch.dict(fitting.PRESETS, {preset: wild}):
        basis = small_model(backend)
        result = fit(picture(), SPLATS, 100, preset=preset, basis=basis, backend=backend)
    assert np.isfinite(figures(result)).all()
    check_sound(result, picture())


# --- Mistakes ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("gaussians", 0, "gaussians is 0; an image of 32x32 takes 1 to 1024"),
        ("gaussians", -3, "gaussians is -3"),
        ("gaussians", SIDE * SIDE + 1, "gaussians is 1025; an image of 32x32 takes 1 to 1024"),
        ("iterations", -1, "iterations is -1; it must be at least 0"),
        ("solve_steps", -1, "solve_steps is -1"),
        ("init", "eigen2", "init 'eigen2' is unknown; use one of auto, random, grid, adaptive"),
        ("preset", "best", "preset 'best' is unknown; use one of default, gaussianimage"),
        ("color", "hsv", "color 'hsv' is unknown; use one of ycbcr, rgb, linear, data"),
        ("backend", "opencl", "backend 'opencl' is unknown"),
        ("image", np.zeros((0, 4, 3)), "image"),
        ("image", np.full((4, 4, 3), np.nan), "image"),
        ("image", np.zeros((4, 4, 7)), "image"),
    ],
)
def test_arguments_out_of_range(name, value, words):
    arguments = {"image": picture(), "gaussians": SPLATS, "iterations": 3, name: value}
    if name == "image":
        arguments["gaussians"] = 1
    with pytest.raises(ValueError) as error:
        fit(**arguments)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("color", "hint"), [("linear", "another init"), ("rgb", "train a basis")])
def test_a_basis_of_another_space(backend, color, hint):
    with pytest.raises(ValueError, match=f"color is '{color}', but the basis .* or {hint}"):
        fit(picture(), init="eigen", basis=small_model(backend), color=color, backend=backend)


@pytest.mark.parametrize(("name", "value"), [("seed", -1), ("gaussians", 2.5), ("iterations", 2.5)])
def test_errors_name_the_argument(name, value):
    arguments = {"gaussians": SPLATS, "iterations": 3, name: value}
    with pytest.raises((ValueError, TypeError), match=name):
        fit(picture(), **arguments)


def test_schedules_are_plain_values():
    """Two of the same numbers are the same."""
    assert Schedule(Adam, {"mean": 1.0}) == Schedule(Adam, {"mean": 1.0})

"""`fit`: one image to Gaussians, whatever the image, the options, and how it ends."""

import signal
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

from _helpers.families import small_model
from _helpers.waves import SIDE, SPLATS, figures, picture, presets
from eigengs_dr.fitting import initializers as starting
from eigengs_dr.fitting.fit import FitInterrupted, fit
from eigengs_dr.fitting.initializers import DARKNESS
from eigengs_dr.fitting.placement.grid import place_grid
from eigengs_dr.fitting.presets import PRESETS
from eigengs_dr.image.color import SPACES, to_coded, to_linear
from eigengs_dr.image.metrics import psnr
from eigengs_dr.image.samples import sample
from eigengs_dr.raster.render import picture_of, render


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


@pytest.mark.parametrize("init", ("auto", *starting.INITIALIZERS))
def test_fit_improves_on_its_start(backend, init):
    basis = small_model(backend) if init == "eigen" else None
    result = fit(picture(), SPLATS, 60, init=init, basis=basis, backend=backend)
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
    init, basis = ("auto", small_model(backend)) if eigen else ("random", None)

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
    basis = small_model(backend) if preset == "eigengs" else None
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
    """Without weights, what shows there after coding would be worse: three crops, for chance."""
    photo, light = sample("coffee"), np.linspace(0.05, 1, SIDE, dtype=np.float32)[:, None, None]
    logarithms = []
    for y, x in ((100, 100), (200, 300), (50, 400)):
        dark, shown = photo[y : y + SIDE, x : x + SIDE] * light, []
        for darkness in (DARKNESS, 0.0):
            monkeypatch.setattr(starting, "DARKNESS", darkness)
            image = fit(dark, SPLATS, 60, color="linear", backend=backend).image
            shown.append(np.square(image - dark)[: SIDE // 3].mean())
        logarithms.append(np.log(shown[0] / shown[1]))
    assert np.mean(logarithms) < np.log(0.85)


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
    # A value between two codes may be rounded to either: another order of sums has other last bits.
    shown, wanted = (
        255 * np.clip(image, 0, 1).astype(np.float64) for image in (result.image, data)
    )
    errors = [(np.rint(shown + tie) - np.rint(wanted)) ** 2 / 255**2 for tie in (-1e-4, 1e-4)]
    most, least = (-10 * np.log10(f(*errors).mean()) for f in (np.maximum, np.minimum))
    assert most - 1e-6 <= best["psnr_rgb"] <= least + 1e-6
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


@pytest.mark.parametrize("color", SPACES)
def test_the_image_is_left_alone(backend, color):
    """An image of float32 is not copied, so nothing may write to it: it can be read-only."""
    image = picture()
    image.setflags(write=False)
    found = fit(image, SPLATS, 3, color=color, backend=backend)
    np.testing.assert_array_equal(image, picture())
    expected = fit(picture().astype(np.float64), SPLATS, 3, color=color, backend=backend)
    np.testing.assert_array_equal(found.image, expected.image)


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

    with pytest.raises(FitInterrupted) as interruption:
        fit(picture(), SPLATS, 60, progress=interrupt, backend=backend)
    result = interruption.value.result
    check_sound(result, picture())
    assert (result.iterations, result.stopped) == (when, "interrupted")
    rows = [row["iteration"] for row in result.trace]
    assert rows == sorted({m for m in (0, 10, 20, 50) if m <= when} | {when})
    assert max(figures(result)) == psnr(picture(), result.image, space="ycbcr")


def press_ctrl_c(*arguments):
    signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals(backend, number):
    """They end the run at the next step, and are the caller's again afterwards."""
    before = signal.getsignal(number)

    def progress(iteration, iterations, row):
        if iteration == 10:
            signal.raise_signal(number)

    with pytest.raises(KeyboardInterrupt) as interruption:
        fit(picture(), SPLATS, 60, progress=progress, backend=backend)
    result = interruption.value.result
    assert result.stopped == "interrupted"
    assert result.iterations in (10, 11)
    assert [row["iteration"] for row in result.trace] == [0, 10]
    assert all(np.isfinite(v).all() for v in result.gaussians.to_arrays().values())
    assert signal.getsignal(number) is before


def test_a_loop_over_images_ends(backend):
    """Ctrl-C in one fit ends the loop around it."""
    fitted = []
    with pytest.raises(KeyboardInterrupt):
        for k in range(3):
            progress = press_ctrl_c if k == 1 else None
            fitted.append(fit(picture(), SPLATS, 10, progress=progress, backend=backend))
    assert len(fitted) == 1


def place_and_press(image, count, generator):
    press_ctrl_c()
    return place_grid(image, count, generator)


def place_and_fail(image, count, generator):
    return 1 / 0


@pytest.mark.parametrize("iterations", [0, 1, 60])
def test_ctrl_c_before_refinement(backend, iterations):
    """The start is kept, and the caller told."""
    entry = {"grid": f"{__name__}:place_and_press"}
    with patch.dict(starting.PLACEMENTS, entry), pytest.raises(FitInterrupted) as interruption:
        fit(picture(), SPLATS, iterations, init="grid", backend=backend)
    result = interruption.value.result
    check_sound(result, picture())
    assert len(result.trace) == 1
    assert result.stopped == "interrupted"


def test_ctrl_c_is_the_callers_after_an_error(backend):
    before = signal.getsignal(signal.SIGINT)
    entry = {"grid": f"{__name__}:place_and_fail"}
    with patch.dict(starting.PLACEMENTS, entry), pytest.raises(ZeroDivisionError):
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
    with patch.dict(PRESETS, {preset: wild}):
        basis = small_model(backend) if preset == "eigengs" else None
        result = fit(picture(), SPLATS, 100, preset=preset, basis=basis, backend=backend)
    assert np.isfinite(figures(result)).all()
    check_sound(result, picture())


# --- Mistakes ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("gaussians", 0, "gaussians is 0; an image of 32x32 takes 1 to 1024"),
        ("gaussians", -3, "gaussians is -3; it must be at least 1"),
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


def test_the_repr_is_short(backend):
    """It shows figures, and neither pixels nor the trace."""
    text = repr(fit(picture(), SPLATS, 0, backend=backend))
    assert len(text) < 200 and f"{SPLATS} Gaussians" in text and "psnr_rgb=" in text


def test_a_cutoff_stays_with_its_set(backend):
    result = fit(picture(), SPLATS, 10, cutoff=4, backend=backend)
    assert result.gaussians.cutoff == 4
    shown = render(result.gaussians).numpy()
    np.testing.assert_array_equal(shown, result.image)
    assert not np.array_equal(render(result.gaussians, cutoff=3).numpy(), shown)


def test_seeds_of_the_default_preset_give_one_result(backend):
    sets = [fit(picture(), SPLATS, 0, seed=seed, backend=backend).gaussians for seed in (0, 1)]
    for first, second in zip(*(g.to_arrays().values() for g in sets), strict=True):
        np.testing.assert_array_equal(first, second)
